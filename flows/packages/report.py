"""What goes with a package: `report.json` and `report.html` for people, `provenance.json` for checking it."""

import html
import json
import math
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from flows.engine.tasks import Finished, Made
from flows.inputs.orders import Order
from flows.packages.acceptance import picture_of, section, verdict_of
from flows.packages.crate import CRATE, crate_text
from flows.packages.credentials import Claim, Signer, certificate, sidecar_of
from flows.packages.publish import FORMAT, RECORD, Files, fact_of_bytes, readable
from flows.packages.view import VIEWER, page_of
from flows.ui.curves import HEIGHT, WIDTH, amount, drawing, inked, summary
from steps.contract import RUN_ONLY, StepResult, canonical
from steps.store.artifact_store import ArtifactStore

BESIDE = ("report.json", "report.html", VIEWER, CRATE)
GENERATIVE = ("draw_picture", "drive_video", "fit_gaussians", "fit_motion", "refine_texture")  # where they use weights
UNSIGNED: Mapping[str, Any] = MappingProxyType({})


def complete(
    folder: Path, files: Files, order: Order, made: Made, store: ArtifactStore, signer: Signer | None
) -> Files:
    """Sign the files of a package if there is a signer, and write what goes with them; their facts as they are then."""
    signatures = UNSIGNED
    claim = Claim(_used_weights(made, *GENERATIVE), f"{banner(order, made)} Package {made.package.digest}.")
    if signer is not None:
        files, signed = signer.sign_package(folder, files, claim)
        signatures = {"certificate": certificate(), "subject": signer.subject, "files": signed}
    for name, text in texts(order, made, files, store, folder, signatures).items():
        (folder / name).write_text(text, encoding="utf-8")
    if signer is not None:
        signer.sign_beside(folder / CRATE, claim)  # it holds the digest of every other file
    return files


def texts(
    order: Order,
    made: Made,
    files: Files,
    store: ArtifactStore,
    folder: Path,
    signatures: Mapping[str, Any] = UNSIGNED,
) -> dict[str, str]:
    """The texts that go with the package in a folder, by name of file."""
    report = report_of(order, made, files, store)
    record = provenance(order, made, files, signatures)
    written = json.dumps(record, indent=1, ensure_ascii=False, sort_keys=True) + "\n"
    beside = {
        VIEWER: page_of(json.loads(written), lambda name: (folder / name).read_bytes()),  # as `dg4d view` will see it
        "report.json": json.dumps(report, indent=1, ensure_ascii=False) + "\n",
        "report.html": page(report, picture_of(_results(made), store)),
        RECORD: written,
    }
    facts = {name: fact_of_bytes(text.encode()) for name, text in beside.items()}
    return {**beside, CRATE: crate_text(record, facts, banner(order, made))}


def provenance(order: Order, made: Made, files: Files, signatures: Mapping[str, Any] = UNSIGNED) -> dict[str, Any]:
    """Every step's record, every file's digest, and the recipe; what belongs to one run only stands under `run`.

    Signatures never come out twice the same: where there are any, `files` and `signatures` belong to one run as well.
    """
    records = [done.result.provenance for done in made.steps]
    outputs = [ref for done in made.steps for ref in done.result.outputs.values()]
    artifacts = [ref for ref in (order.source, order.bank, *outputs) if ref is not None]
    return {
        "format": FORMAT,
        "order": order.digest(),
        "item": order.item,
        "profile": order.profile,
        "source": order.source.digest,
        "seed": order.seed,
        "commercial_only": order.commercial_only,
        "recipe": order.recipe(),
        "licenses": licenses(made),
        "package": made.package.digest,
        "artifacts": {ref.digest: ref.model_dump(mode="json", exclude={"digest"}) for ref in artifacts},
        "files": files,
        "signatures": dict(signatures),
        "beside": [*BESIDE, *([sidecar_of(CRATE)] if signatures else [])],
        "steps": [
            {"digest": record.digest(), **record.model_dump(mode="json", exclude=set(RUN_ONLY))} for record in records
        ],
        "run": {
            "flow_run": made.flow_run,
            "names": {"source_name": order.source_name, "picture_name": order.picture_name},
            "steps": [
                {
                    "step": done.label,
                    "cached": done.cached,
                    **done.result.provenance.model_dump(mode="json", include=set(RUN_ONLY)),
                }
                for done in made.steps
            ],
        },
    }


def report_of(order: Order, made: Made, files: Files, store: ArtifactStore) -> dict[str, Any]:
    """Stages, times, curves, notes and settings as JSON."""
    return {
        "item": order.item,
        "source": order.source_name,
        "profile": order.profile,
        "seed": order.seed,
        "commercial_only": order.commercial_only,
        "banner": banner(order, made),
        "notes": notes(order, made),
        "wall_s": round(made.wall_s, 1),
        "compute_s": round(sum(done.result.provenance.duration_s for done in made.steps), 1),
        "peak_memory_mb": max(done.result.provenance.peak_memory_mb for done in made.steps),
        "acceptance": verdict_of(_results(made), store),
        "steps": [_stage(done, store) for done in made.steps],
        "licenses": licenses(made),
        "files": {name: fact["size_bytes"] for name, fact in files.items()},
        "settings": order.settings.model_dump(mode="json"),
    }


def banner(order: Order, made: Made) -> str:
    """One honest sentence: what of this asset was seen and what was guessed."""
    given = any("footage" in done.result.outputs for done in made.steps)
    imagined = "the motion was made up by a model" if _used_weights(made, "drive_video") else "the motion was made up"
    motion = "the motion follows the video" if given else imagined
    if order.settings.prior.kind == "oracle":
        return f"Test of the optimization: the true views were known; {motion}."
    drawn = "the picture was drawn by a model; " if order.drawn else ""
    weights = _used_weights(made, "fit_gaussians", "fit_motion")
    shape = "guessed by a model" if weights else "guessed without a model, from the outline of one picture"
    return f"{order.profile.capitalize()}: {drawn}{motion}; shape and the sides nobody saw were {shape}."


def licenses(made: Made) -> dict[str, str]:
    """The licenses that follow the asset, by what they are of; empty where no weights were used."""
    return {name: terms for done in made.steps for name, terms in done.result.provenance.licenses.items()}


def notes(order: Order, made: Made) -> list[str]:
    """What the user should know, each sentence once."""
    own = []
    if order.picture_name:
        own.append(f"The subject is the first frame of {order.source_name}; {order.picture_name} only names the asset.")
    records = [done.result.provenance for done in made.steps]
    theirs = (note for record in records for note in (*record.notes, *record.run_notes))
    return list(dict.fromkeys([*own, *theirs]))


def page(report: dict[str, Any], shortcomings: bytes | None = None) -> str:
    """The report as one page; the pictures are the package's own, beside it, but for that of its shortcomings (PNG)."""
    files = report["files"]
    parts = [
        f"<h1>{_text(report['item'])}</h1>",
        f"<p class=banner>{_text(report['banner'])}</p>",
        f'<p><a href="{VIEWER}">look at it from all sides</a></p>',
        _pictures(files),
        "".join(f"<p class=note>{_text(note)}</p>" for note in report["notes"]),
        *(["<h2>Acceptance</h2>", section(report["acceptance"], shortcomings)] if report["acceptance"] else []),
        "<h2>Stages</h2>",
        _stages(report),
        "".join(_curves(stage) for stage in report["steps"] if stage["curves"]),
        "<h2>Files</h2>",
        _files(files),
        "<h2>Licenses</h2>",
        _licenses(report["licenses"]),
        "<h2>Settings</h2>",
        f"<p>profile <b>{_text(report['profile'])}</b>, seed <b>{report['seed']}</b>, source "
        f"<b>{_text(report['source'])}</b></p>",
        f"<details><summary>every knob</summary><pre>{_text(json.dumps(report['settings'], indent=1))}</pre></details>",
        "<p class=small>The digest of every file and the record of every step are in "
        '<a href="provenance.json">provenance.json</a>; the numbers of this page in '
        '<a href="report.json">report.json</a>.</p>',
    ]
    return _PAGE.format(title=_text(report["item"]), body="\n".join(parts))


def curve(curves: dict[str, Any]) -> str:
    """Losses over iterations as inline SVG; empty if there is nothing to draw."""
    drawn = drawing(curves)
    if not drawn:
        return ""
    legend = [
        f'<span style="color:{ink}">&#9632; {_text(name)} {amount(points[-1])}</span>'
        for ink, name, points in inked(curves)
    ]
    return (
        f"<figure><figcaption>{_text(curves['title'])}</figcaption>"
        f'<svg viewBox="-4 -4 {WIDTH + 8} {HEIGHT + 8}" role="img">{drawn}</svg>'
        f"<p class=small>{summary(curves)}</p><p class=small>{' '.join(legend)}</p></figure>"
    )


def _results(made: Made) -> list[StepResult]:
    return [done.result for done in made.steps]


def _used_weights(made: Made, *steps: str) -> bool:
    records = [done.result.provenance for done in made.steps]
    return any(record.weights for record in records if record.step in steps)


def _stage(done: Finished, store: ArtifactStore) -> dict[str, Any]:
    record = done.result.provenance
    curves = [
        json.loads(store.path(ref).read_text(encoding="utf-8"))
        for ref in done.result.outputs.values()
        if ref.media_type.endswith("curves+json") and store.has(ref)
    ]
    return {
        "step": done.label,
        "cached": done.cached,
        "wall_s": done.wall_s,
        "waited_s": done.waited_s,
        "compute_s": record.duration_s,
        "peak_memory_mb": record.peak_memory_mb,
        "backend": record.backend,
        "notes": [*record.notes, *record.run_notes],
        "flops": record.flops,
        "curves": curves,
    }


def arithmetic(flops: dict[str, int]) -> str:
    """What each network did, for people: "UNet2DConditionModel 15.3 TFLOP"."""
    return ", ".join(f"{name} {_scaled(count)}FLOP" for name, count in flops.items())


def _scaled(count: float) -> str:
    """With the prefix of the unit."""
    power = min(max(int(math.log10(max(count, 1))) // 3, 2), 5)
    return f"{count / 1000**power:,.1f} {'..MGTP'[power]}"


def _pictures(files: dict[str, int]) -> str:
    shown = []
    if "preview.mp4" in files:
        shown.append('<video src="preview.mp4" autoplay loop muted playsinline controls></video>')
    if "contact_sheet.png" in files:
        shown.append('<img src="contact_sheet.png" alt="columns: moments; rows: angles">')
    return f"<div class=pictures>{''.join(shown)}</div>"


def _stages(report: dict[str, Any]) -> str:
    longest = max((stage["compute_s"] for stage in report["steps"]), default=0) or 1
    rows = "".join(
        f"<tr><td>{_text(stage['step'])}<td class=number>{stage['compute_s']:.1f} s"
        f"<td><div class=bar style='width:{120 * stage['compute_s'] / longest:.0f}px'></div>"
        f"<td class=number>{stage['peak_memory_mb']:.0f} MiB<td>{_text(stage['backend'])}"
        f"<td>{_text(arithmetic(stage['flops']))}"
        f"<td>{'taken from before' if stage['cached'] else ''}"
        for stage in report["steps"]
    )
    return (
        "<table><tr><th>stage<th>computed in<th><th>peak memory<th>backend<th>networks<th>"
        f"{rows}</table><p class=small>{report['wall_s']:.1f} s on the clock for this run; "
        f"{report['compute_s']:.1f} s of computing in all stages, now or before, some side by side.</p>"
    )


def _curves(stage: dict[str, Any]) -> str:
    return "".join(curve(curves) for curves in stage["curves"])


def _files(files: dict[str, int]) -> str:
    rows, folders = [], dict[str, list[int]]()
    for name, size in files.items():
        folder, slash, _ = name.partition("/")
        if slash:
            folders.setdefault(folder, []).append(size)
        else:
            rows.append(f'<tr><td><a href="{_text(name)}">{_text(name)}</a><td class=number>{readable(size)}')
    rows += [
        f'<tr><td><a href="{_text(name)}/">{_text(name)}/</a> ({len(sizes)} file{"s" * (len(sizes) != 1)})'
        f"<td class=number>{readable(sum(sizes))}"
        for name, sizes in folders.items()
    ]
    return f"<table>{''.join(rows)}</table>"


def _licenses(terms: dict[str, str]) -> str:
    if not terms:
        return "<p>No weights were used: no license of a model follows this asset.</p>"
    rows = "".join(f"<tr><td>{_text(name)}<td>{_text(its)}" for name, its in terms.items())
    return f"<p>Weights were used; their licenses follow this asset.</p><table>{rows}</table>"


def _text(value: object) -> str:
    return html.escape(value if isinstance(value, str) else canonical(value))


_PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
:root {{ color-scheme: light dark; --line: #8884; --soft: #8881; }}
body {{ font: 15px/1.5 system-ui, sans-serif; max-width: 980px; margin: 2rem auto; padding: 0 1rem; }}
h1 {{ margin: 0 0 .5rem; font-size: 1.6rem; }} h2 {{ margin: 2rem 0 .5rem; font-size: 1.1rem; }}
.banner {{ border-left: 4px solid #d97706; background: #d9770618; padding: .6rem .9rem; border-radius: 4px; }}
.note {{ border-left: 4px solid var(--line); padding: 0 .9rem; margin: .4rem 0; }}
.pictures {{ display: flex; gap: 1rem; flex-wrap: wrap; align-items: flex-start; }}
.pictures > * {{ flex: 1 1 320px; max-width: 100%; min-width: 0; border: 1px solid var(--line); border-radius: 6px;
  background: repeating-conic-gradient(#fff 0 25%, #eee 0 50%) 0 0 / 20px 20px; }}
table {{ border-collapse: collapse; }} td, th {{ padding: .2rem .8rem .2rem 0; text-align: left; }}
td {{ border-top: 1px solid var(--line); }} .number {{ text-align: right; font-variant-numeric: tabular-nums; }}
.bar {{ height: .7rem; background: #2563eb; border-radius: 2px; }}
.verdict {{ font-weight: 600; }}
.passed td:first-child {{ color: #059669; }} .missed td:first-child {{ color: #dc2626; }}
.gates td {{ vertical-align: top; }} .gates td:nth-child(3), .gates td:nth-child(4) {{ white-space: nowrap; }}
.small {{ font-size: .85rem; opacity: .75; margin: .2rem 0; }}
figure {{ display: inline-block; width: min(440px, 100%); margin: 1rem 1rem 0 0; vertical-align: top; }}
figcaption {{ font-weight: 600; }}
svg {{ width: 100%; background: var(--soft); border-radius: 4px; }}
pre {{ overflow: auto; background: var(--soft); padding: .8rem; border-radius: 4px; }}
</style>
{body}
</html>
"""
