"""What goes with a package: `report.json` and `report.html` for people, `provenance.json` for checking it."""

import base64
import json
import math
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from flows import home
from flows.formatting import curves
from flows.formatting.sizes import readable
from flows.inputs.conversion_job import ConversionJob
from flows.inputs.package_record import FORMAT, RECORD
from flows.inputs.signing_key import certificate
from flows.packages import acceptance
from flows.packages.acceptance import picture_of, verdict_of
from flows.packages.crate import CRATE, crate_text
from flows.packages.credentials import Claim, Signer, sidecar_of
from flows.packages.flow_result import FlowResult, StepRun
from flows.packages.html_pages import render
from flows.packages.publish import Files, Swap, bytes_digest, replace_package
from flows.packages.view import VIEWER, page_of
from steps.contract import RUN_ONLY, StepResult
from steps.store.artifact_store import ArtifactStore

BESIDE = ("report.json", "report.html", VIEWER, CRATE)
GENERATIVE = ("draw_picture", "drive_video", "fit_gaussians", "fit_motion", "refine_texture")  # where they use weights
UNSIGNED: Mapping[str, Any] = MappingProxyType({})


def deliver(job: ConversionJob, result: FlowResult, folder: Path, signer: Signer | None) -> Swap:
    """Put the package of a conversion into a folder, with reports and record; see `replace_package`."""
    store = home.store()
    return replace_package(
        store.path(result.package),
        folder,
        lambda staging, files: complete(staging, files, job, result, store, signer),
    )


def complete(
    folder: Path, files: Files, job: ConversionJob, result: FlowResult, store: ArtifactStore, signer: Signer | None
) -> Files:
    """Sign the files of a package if there is a signer, and write what goes with them; their facts as they are then."""
    signatures = UNSIGNED
    claim = Claim(_used_weights(result, *GENERATIVE), f"{banner(job, result)} Package {result.package.digest}.")
    if signer is not None:
        files, signed = signer.sign_package(folder, files, claim)
        signatures = {"certificate": certificate(), "subject": signer.subject, "files": signed}
    for name, text in texts(job, result, files, store, folder, signatures).items():
        (folder / name).write_text(text, encoding="utf-8")
    if signer is not None:
        signer.sign_beside(folder / CRATE, claim)  # it holds the digest of every other file
    return files


def texts(
    job: ConversionJob,
    result: FlowResult,
    files: Files,
    store: ArtifactStore,
    folder: Path,
    signatures: Mapping[str, Any] = UNSIGNED,
) -> dict[str, str]:
    """The texts that go with the package in a folder, by name of file."""
    report = report_of(job, result, files, store)
    record = provenance(job, result, files, signatures)
    written = json.dumps(record, indent=1, ensure_ascii=False, sort_keys=True) + "\n"
    beside = {
        VIEWER: page_of(json.loads(written), lambda name: (folder / name).read_bytes()),  # as `dg4d view` will see it
        "report.json": json.dumps(report, indent=1, ensure_ascii=False) + "\n",
        "report.html": page(report, picture_of(_results(result), store)),
        RECORD: written,
    }
    facts = {name: bytes_digest(text.encode()) for name, text in beside.items()}
    return {**beside, CRATE: crate_text(record, facts, banner(job, result))}


def provenance(
    job: ConversionJob, result: FlowResult, files: Files, signatures: Mapping[str, Any] = UNSIGNED
) -> dict[str, Any]:
    """Every step's record, every file's digest, and the recipe; what belongs to one run only stands under `run`.

    Signatures never come out twice the same: where there are any, `files` and `signatures` belong to one run as well.
    """
    records = [done.result.provenance for done in result.steps]
    outputs = [ref for done in result.steps for ref in done.result.outputs.values()]
    artifacts = [ref for ref in (job.source, job.bank, *outputs) if ref is not None]
    return {
        "format": FORMAT,
        "order": job.digest(),
        "item": job.item,
        "profile": job.profile,
        "source": job.source.digest,
        "seed": job.seed,
        "commercial_only": job.commercial_only,
        "recipe": job.recipe(),
        "licenses": licenses(result),
        "package": result.package.digest,
        "artifacts": {ref.digest: ref.model_dump(mode="json", exclude={"digest"}) for ref in artifacts},
        "files": files,
        "signatures": dict(signatures),
        "beside": [*BESIDE, *([sidecar_of(CRATE)] if signatures else [])],
        "steps": [
            {"digest": record.digest(), **record.model_dump(mode="json", exclude=set(RUN_ONLY))} for record in records
        ],
        "run": {
            "flow_run": result.flow_run,
            "names": {"source_name": job.source_name, "picture_name": job.picture_name},
            "steps": [
                {
                    "step": done.label,
                    "cached": done.cached,
                    **done.result.provenance.model_dump(mode="json", include=set(RUN_ONLY)),
                }
                for done in result.steps
            ],
        },
    }


def report_of(job: ConversionJob, result: FlowResult, files: Files, store: ArtifactStore) -> dict[str, Any]:
    """Stages, times, curves, notes and settings as JSON."""
    return {
        "item": job.item,
        "source": job.source_name,
        "profile": job.profile,
        "seed": job.seed,
        "commercial_only": job.commercial_only,
        "banner": banner(job, result),
        "notes": notes(job, result),
        "wall_s": round(result.wall_s, 1),
        "compute_s": round(sum(done.result.provenance.duration_s for done in result.steps), 1),
        "peak_memory_mb": max(done.result.provenance.peak_memory_mb for done in result.steps),
        "acceptance": verdict_of(_results(result), store),
        "steps": [_stage(done, store) for done in result.steps],
        "licenses": licenses(result),
        "files": {name: fact["size_bytes"] for name, fact in files.items()},
        "settings": job.settings.model_dump(mode="json"),
    }


def banner(job: ConversionJob, result: FlowResult) -> str:
    """One honest sentence: what of this asset was seen and what was guessed."""
    given = any("footage" in done.result.outputs for done in result.steps)
    imagined = "the motion was made up by a model" if _used_weights(result, "drive_video") else "the motion was made up"
    motion = "the motion follows the video" if given else imagined
    if job.settings.prior.kind == "oracle":
        return f"Test of the optimization: the true views were known; {motion}."
    drawn = "the picture was drawn by a model; " if job.drawn else ""
    weights = _used_weights(result, "fit_gaussians", "fit_motion")
    shape = "guessed by a model" if weights else "guessed without a model, from the outline of one picture"
    return f"{job.profile.capitalize()}: {drawn}{motion}; shape and the sides nobody saw were {shape}."


def licenses(result: FlowResult) -> dict[str, str]:
    """The licenses that follow the asset, by what they are of; empty where no weights were used."""
    return {name: terms for done in result.steps for name, terms in done.result.provenance.licenses.items()}


def notes(job: ConversionJob, result: FlowResult) -> list[str]:
    """What the user should know, each sentence once."""
    own = []
    if job.picture_name:
        own.append(f"The subject is the first frame of {job.source_name}; {job.picture_name} only names the asset.")
    records = [done.result.provenance for done in result.steps]
    theirs = (note for record in records for note in (*record.notes, *record.run_notes))
    return list(dict.fromkeys([*own, *theirs]))


def page(report: dict[str, Any], shortcomings: bytes | None = None) -> str:
    """Return the report as one page that shows the files of the package beside it.

    Args:
        report: of `report_of`.
        shortcomings: picture of the worst moments, PNG; it is embedded.
    """
    folders: dict[str, list[int]] = {}
    for name, size in report["files"].items():
        folder, slash, _ = name.partition("/")
        if slash:
            folders.setdefault(folder, []).append(size)
    return render(
        "report.html",
        title=report["item"],
        report=report,
        viewer=VIEWER,
        acceptance=acceptance,
        shortcomings=base64.b64encode(shortcomings or b"").decode(),
        arithmetic=arithmetic,
        curves=curves,
        readable=readable,
        folders=folders,
        settings=json.dumps(report["settings"], indent=1),
    )


def _results(result: FlowResult) -> list[StepResult]:
    return [done.result for done in result.steps]


def _used_weights(result: FlowResult, *steps: str) -> bool:
    records = [done.result.provenance for done in result.steps]
    return any(record.weights for record in records if record.step in steps)


def _stage(done: StepRun, store: ArtifactStore) -> dict[str, Any]:
    record = done.result.provenance
    drawn = [
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
        "curves": drawn,
    }


def arithmetic(flops: dict[str, int]) -> str:
    """What each network did, for people: "UNet2DConditionModel 15.3 TFLOP"."""
    return ", ".join(f"{name} {_scaled(count)}FLOP" for name, count in flops.items())


def _scaled(count: float) -> str:
    """With the prefix of the unit."""
    power = min(max(int(math.log10(max(count, 1))) // 3, 2), 5)
    return f"{count / 1000**power:,.1f} {'..MGTP'[power]}"
