"""Files beside a package: report, provenance record, viewer and crate."""

import base64
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from flows import home
from flows.formatting.curves import svg_picture
from flows.formatting.numbers import format_size
from flows.inputs.conversion_job import ConversionJob
from flows.inputs.package_record import FORMAT, RECORD, REPORT
from flows.inputs.signing_key import certificate_digest
from flows.packages import acceptance
from flows.packages.acceptance import load_picture, load_verdict
from flows.packages.crate import AUTHOR, CRATE, crate_text
from flows.packages.credentials import Claim, Signer, sidecar_name
from flows.packages.flow_result import FlowResult, StepRun
from flows.packages.html_pages import render
from flows.packages.publish import Files, Say, bytes_digest, publish
from flows.packages.view import VIEWER, viewer_html
from steps.contract import RUN_ONLY
from steps.store.artifact_store import ArtifactStore

BESIDE = (REPORT, "report.html", VIEWER, CRATE)
GENERATIVE = (  # steps that generate parts of the asset if they use weights
    "draw_picture", "generate_views", "drive_video", "fit_gaussians", "fit_motion", "refine_texture",
)  # fmt: skip
UNSIGNED: Mapping[str, Any] = MappingProxyType({})


def deliver(
    job: ConversionJob, result: FlowResult, folder: Path, signer: Signer | None, say: Say = lambda _: None
) -> None:
    """Put the package of a conversion with reports and record into a folder; see `publish`."""
    store = home.store()
    publish(
        store.path(result.package),
        folder,
        lambda staging, files: finish_package(staging, files, job, result, store, signer),
        say,
    )


def finish_package(
    folder: Path, files: Files, job: ConversionJob, result: FlowResult, store: ArtifactStore, signer: Signer | None
) -> Files:
    """Sign a package if there is a signer, write the files beside it, and return the digests of its files."""
    signatures = UNSIGNED
    claim = Claim(result.used_weights(*GENERATIVE), f"{banner(job, result)} Package {result.package.digest}.")
    if signer is not None:
        files, signed = signer.sign_package(folder, files, claim)
        signatures = {"certificate": certificate_digest(), "subject": signer.subject, "files": signed}
    for name, text in render_records(job, result, files, store, folder, signatures).items():
        (folder / name).write_text(text, encoding="utf-8")
    if signer is not None:
        signer.sign_sidecar(folder / CRATE, claim)  # the crate holds the digest of every other file
    return files


def render_records(
    job: ConversionJob,
    result: FlowResult,
    files: Files,
    store: ArtifactStore,
    folder: Path,
    signatures: Mapping[str, Any] = UNSIGNED,
) -> dict[str, str]:
    """Return the texts of the files beside the package in a folder, by file name."""
    report = build_report(job, result, files, store)
    record = provenance(job, result, files, signatures)
    written = json.dumps(record, indent=1, ensure_ascii=False, sort_keys=True) + "\n"
    beside = {
        VIEWER: viewer_html(
            json.loads(written), lambda name: (folder / name).read_bytes()
        ),  # as `dg4d view` will see it
        REPORT: json.dumps(report, indent=1, ensure_ascii=False) + "\n",
        "report.html": report_page(
            report, load_picture(result.results, store), acceptance.load_cutout(result.results, store)
        ),
        RECORD: written,
    }
    facts = {name: bytes_digest(text.encode()) for name, text in beside.items()}
    return {**beside, CRATE: crate_text(record, facts, banner(job, result), os.environ.get(AUTHOR, ""))}


def provenance(
    job: ConversionJob, result: FlowResult, files: Files, signatures: Mapping[str, Any] = UNSIGNED
) -> dict[str, Any]:
    """Return the provenance record: steps, file digests and recipe; facts of a single run are under `run`.

    Signatures differ in every run: in a signed package `files` and `signatures` are facts of a single run, too.
    """
    outputs = [ref for done in result.steps for ref in done.result.outputs.values()]
    artifacts = [*job.given().values(), *outputs]
    return {
        "format": FORMAT,
        "order": job.digest(),
        "item": job.item,
        "profile": job.profile,
        "source": job.source.digest,
        "seed": job.seed,
        "commercial_only": job.commercial_only,
        "recipe": job.recipe(),
        "licenses": result.licenses,
        "package": result.package.digest,
        "artifacts": {ref.digest: ref.model_dump(mode="json", exclude={"digest"}) for ref in artifacts},
        "files": files,
        "signatures": dict(signatures),
        "beside": [*BESIDE, *([sidecar_name(CRATE)] if signatures else [])],
        "steps": [
            {"digest": record.digest(), **record.model_dump(mode="json", exclude=set(RUN_ONLY))}
            for record in result.records
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


def build_report(job: ConversionJob, result: FlowResult, files: Files, store: ArtifactStore) -> dict[str, Any]:
    """Return steps, times, curves, notes and settings as JSON."""
    return {
        "item": job.item,
        "source": job.source_name,
        "profile": job.profile,
        "seed": job.seed,
        "commercial_only": job.commercial_only,
        "banner": banner(job, result),
        "notes": notes(job, result),
        "wall_s": round(result.wall_s, 1),
        "compute_s": round(sum(record.duration_s for record in result.records), 1),
        "peak_memory_mb": max(record.peak_memory_mb for record in result.records),
        "acceptance": load_verdict(result.results, store),
        "steps": [_stage(done, store) for done in result.steps],
        "licenses": result.licenses,
        "files": {name: fact["size_bytes"] for name, fact in files.items()},
        "settings": job.settings.model_dump(mode="json"),
    }


def banner(job: ConversionJob, result: FlowResult) -> str:
    """Say in one sentence which parts of the asset were observed and which were generated."""
    given = any("footage" in done.result.outputs for done in result.steps)
    by_model = " by a model" if result.used_weights("drive_video") else ""
    motion = "the motion follows the video" if given else f"the motion was generated{by_model}"
    if job.settings.prior.kind == "oracle":
        return f"Test of the optimization: ground-truth views were given; {motion}."
    picture = "the picture was generated from text; " if job.generates_picture else ""
    return f"{job.profile.capitalize()}: {picture}{motion}; {_shape(job, result)}."


def _shape(job: ConversionJob, result: FlowResult) -> str:
    """Say which part of the shape was given, and how the rest was predicted."""
    if job.asset is not None:
        return "the shape is that of the given model"
    if job.settings.prior.kind == "learned" and not result.used_weights("generate_views"):
        predicted, source = "by the shape network", " from one view"
    elif result.used_weights("generate_views", "fit_gaussians", "fit_motion"):
        predicted, source = "by a model", ""
    else:
        predicted, source = "without a model", ", from the silhouette of one picture"
    if job.views is not None:
        return f"the shape was fitted to the given views; what none of them shows was predicted {predicted}"
    return f"shape and unseen sides were predicted {predicted}{source}"


def notes(job: ConversionJob, result: FlowResult) -> list[str]:
    """Return the notes for the user, each once."""
    own = []
    if job.picture_name:
        own.append(f"The subject is the first frame of {job.source_name}; {job.picture_name} only names the asset.")
    theirs = (note for record in result.records for note in (*record.notes, *record.run_notes))
    return list(dict.fromkeys([*own, *theirs]))


def report_page(report: dict[str, Any], shortcomings: bytes | None = None, cutout: bytes | None = None) -> str:
    """Render the report as a page that shows the files of the package.

    Args:
        report: of `build_report`.
        shortcomings: picture of the worst frames, PNG; it is embedded.
        cutout: picture of source, matte and cut-out, PNG; it is embedded.
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
        cutout=base64.b64encode(cutout or b"").decode(),
        format_flops=format_flops,
        svg_picture=svg_picture,
        format_size=format_size,
        folders=folders,
        settings=json.dumps(report["settings"], indent=1),
    )


def _stage(done: StepRun, store: ArtifactStore) -> dict[str, Any]:
    record = done.result.provenance
    curves = [
        store.load_json(ref)
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


def format_flops(flops: dict[str, int]) -> str:
    """Return the operations of each network, such as "UNet2DConditionModel 15.3 TFLOP"."""
    return ", ".join(f"{name} {_with_prefix(count)}FLOP" for name, count in flops.items())


def _with_prefix(count: float) -> str:
    power = min(max(int(math.log10(max(count, 1))) // 3, 2), 5)
    return f"{count / 1000**power:,.1f} {'..MGTP'[power]}"
