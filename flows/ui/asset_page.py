"""Page of a finished asset in the Prefect UI: pictures, curves, gates, steps and links."""

from collections.abc import Sequence
from typing import Any

from flows.formatting import curves
from flows.formatting.escaping import markdown
from flows.packages import acceptance
from flows.packages.flow_result import StepRun
from flows.serving.addresses import VIEWER_ADDRESS
from flows.ui import pages
from flows.ui.showing import create_page
from steps.contract import ArtifactRef
from steps.store.artifact_store import ArtifactStore

PICTURES = {
    ("pack_asset", "sheet"): "Contact sheet",
    ("draw_picture", "picture"): "Generated from the prompt",
    ("prepare_subject", "picture"): "Input, matte, cut-out",
    ("prepare_views", "picture"): "Views and their visual hull",
    ("generate_views", "picture"): "Generated views (faded where they disagree) and their visual hull",
    ("drive_video", "picture"): "Driving video",
    ("fit_gaussians", "picture"): "Static Gaussians from all sides",
    ("fit_motion", "picture"): "Animation from the front and from the side",
    ("extract_mesh", "picture"): "Mesh from all sides",
    ("check_asset", "picture"): "Worst frames: input, splats, mesh",
}


def show_asset(item: str, finished: Sequence[StepRun], package: ArtifactRef, store: ArtifactStore) -> None:
    """Create the page of an asset; Prefect keeps one version for each conversion under the same key.

    Args:
        item: name of the asset.
        finished: its steps, in order.
        package: the package.
        store: with all artifacts of the steps.
    """
    page = asset_page(item, finished, package, store)
    create_page(pages.key("asset", item), page, f"{markdown(item)}: everything on one page")


def asset_page(item: str, finished: Sequence[StepRun], package: ArtifactRef, store: ArtifactStore) -> str:
    """Return the page: pictures, loss curves, gates, notes and a table of steps."""
    links = [f"[{label}]({address})" for label, address in addresses(item, package).items()]
    lines = [f"# {markdown(item)}", "", " · ".join([*links, f"`{package.digest}`"]), ""]
    first = {done.result.provenance.step: done.result.outputs for done in reversed(finished)}
    for (step, output), title in PICTURES.items():
        if output in first.get(step, {}) and (small := pages.thumbnail(first[step][output], store)):
            lines += [f"## {title}", "", pages.embedded(title, "image/webp", small), ""]
    for result in (done.result for done in finished):
        for ref in result.outputs.values():
            if ref.media_type.endswith("curves+json"):
                lines += curve_picture(store.load_json(ref))
    verdict = acceptance.load_verdict((done.result for done in finished), store)
    if verdict is not None:
        lines += ["## Gates", "", *acceptance.markdown(verdict)]
    notes = dict.fromkeys(note for done in finished for note in done.result.provenance.notes)
    lines += ["## Notes", "", *(f"- {markdown(note)}" for note in notes), ""] if notes else []
    rows = timings(finished)
    lines += ["## Steps", "", f"| {' | '.join(rows[0])} |", "|" + "---|" * len(rows[0])]
    lines += [f"| {' | '.join(row.values())} |" for row in rows]
    return "\n".join(lines) + "\n"


def addresses(item: str, package: ArtifactRef) -> dict[str, str]:
    """Return the paths of the package and of its viewer on the background server."""
    name = pages.key("asset", item)
    return {
        "package": pages.address(name, package, ".zip"),
        "viewer": pages.address(name, package, ".html", VIEWER_ADDRESS),
    }


def timings(finished: Sequence[StepRun]) -> list[dict[str, str]]:
    """Return a row per step: cached or computed, times, memory, request digest and record digest."""
    return [
        {
            "step": done.label,
            "state": "cached" if done.cached else "computed",
            "wall_s": f"{done.wall_s:.1f}",
            "waited_s": f"{done.waited_s:.1f}",
            "compute_s": f"{done.result.provenance.duration_s:.1f}",
            "memory": f"{done.result.provenance.peak_memory_mb:.0f} MiB",
            "key": done.result.provenance.request_digest[7:19],
            "record": done.result.provenance.digest()[7:19],
        }
        for done in finished
    ]


def curve_picture(values: dict[str, Any]) -> list[str]:
    """Return a loss curve as lines of Markdown; none if it has no values to draw."""
    plot = curves.svg_picture(values)
    title = f"Losses of the {values['title']}"
    return [f"## {title}", "", pages.embedded(title, "image/svg+xml", plot.encode()), ""] if plot else []
