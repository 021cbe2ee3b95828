"""What the Prefect UI shows of a finished asset: a page with everything on it, two tables, and links to what it is."""

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from prefect.artifacts import create_link_artifact, create_markdown_artifact, create_table_artifact

from flows.packages import acceptance
from flows.ui import curves, pages
from flows.ui.escaping import markdown
from flows.ui.showing import show
from steps.contract import ArtifactRef
from steps.store.artifact_store import ArtifactStore

if TYPE_CHECKING:
    from flows.engine.tasks import Finished

PICTURES = {
    ("pack_asset", "sheet"): "Contact sheet",
    ("draw_picture", "picture"): "Drawn from the words",
    ("prepare_subject", "picture"): "Input, matte, cut-out",
    ("drive_video", "picture"): "Driving video",
    ("fit_gaussians", "picture"): "At rest, from all around",
    ("fit_motion", "picture"): "In motion, from the front and from the side",
    ("extract_mesh", "picture"): "Mesh, from all around",
    ("check_asset", "picture"): "The worst moments: input, splats, mesh",
}


def show_asset(item: str, finished: Sequence["Finished"], package: ArtifactRef, store: ArtifactStore) -> None:
    """Make the page, the tables and the links of an asset; each is a new version under the same key as the last time.

    Args:
        item: name of the asset.
        finished: its steps, in order.
        package: what came out.
        store: where all of it is.
    """
    show(
        create_markdown_artifact,
        key=pages.key("asset", item),
        markdown=asset_page(item, finished, package, store),
        description=f"{markdown(item)}: everything on one page",
    )
    show(
        create_table_artifact,
        key=pages.key("timings", item),
        table=timings(finished),
        description=f"Steps of {markdown(item)}",
    )
    verdict = acceptance.verdict_of((done.result for done in finished), store)
    if verdict is not None:
        show(
            create_table_artifact,
            key=pages.key("gates", item),
            table=gate_rows(verdict),
            description=f"Metrics of {markdown(item)} and their gates",
        )
    for label, address in addresses(item, package).items():
        show(
            create_link_artifact,
            key=pages.key(label, item),
            link=address,
            link_text=f"{label} of {markdown(item)}",
            description=f"The {label}",
        )


def asset_page(item: str, finished: Sequence["Finished"], package: ArtifactRef, store: ArtifactStore) -> str:
    """Pictures, curves, gates, notes and steps of an asset as Markdown."""
    links = [f"[{label}]({address})" for label, address in addresses(item, package).items()]
    lines = [f"# {markdown(item)}", "", " · ".join([*links, f"`{package.digest}`"]), ""]
    first = {done.result.provenance.step: done.result.outputs for done in reversed(finished)}
    for (step, output), title in PICTURES.items():
        if output in first.get(step, {}) and (small := pages.thumbnail(first[step][output], store)):
            lines += [f"## {title}", "", pages.embedded(title, "image/webp", small), ""]
    for result in (done.result for done in finished):
        for ref in result.outputs.values():
            if ref.media_type.endswith("curves+json"):
                lines += curve_picture(json.loads(store.path(ref).read_text(encoding="utf-8")))
    verdict = acceptance.verdict_of((done.result for done in finished), store)
    if verdict is not None:
        lines += ["## Gates", "", *acceptance.markdown(verdict)]
    notes = dict.fromkeys(note for done in finished for note in done.result.provenance.notes)
    lines += ["## Notes", "", *(f"- {markdown(note)}" for note in notes), ""] if notes else []
    rows = timings(finished)
    lines += ["## Steps", "", f"| {' | '.join(rows[0])} |", "|" + "---|" * len(rows[0])]
    lines += [f"| {' | '.join(row.values())} |" for row in rows]
    return "\n".join(lines) + "\n"


def addresses(item: str, package: ArtifactRef) -> dict[str, str]:
    """Where the background server has the package and the page that plays it."""
    name = pages.key("asset", item)
    return {
        "package": pages.address(name, package, ".zip"),
        "viewer": pages.address(name, package, ".html", pages.VIEWER_ADDRESS),
    }


def timings(finished: Sequence["Finished"]) -> list[dict[str, str]]:
    """A row per step: where its result came from, how long it took, and the digests that say what was done."""
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


def gate_rows(verdict: dict[str, Any]) -> list[dict[str, str]]:
    """A row per gate: the metric, its bounds, and whether it lies within."""
    return [
        {
            "gate": gate["name"],
            "value": f"{gate['value']:.4g} {gate['unit']}".strip(),
            "bounds": acceptance.bounds(gate),
            "passed": "yes" if gate["passed"] else "no",
            "of": gate["form"],
            "meaning": gate["meaning"],
        }
        for gate in verdict["gates"]
    ]


def curve_picture(values: dict[str, Any]) -> list[str]:
    """A loss curve as lines of Markdown; none if there is nothing to draw."""
    drawn = curves.picture(values)
    title = f"Losses of the {values['title']}"
    return [f"## {title}", "", pages.embedded(title, "image/svg+xml", drawn.encode()), ""] if drawn else []
