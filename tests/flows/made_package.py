"""A package as a flow would leave it, without running one."""

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from flows.inputs.conversion_job import ConversionJob
from flows.packages.credentials import configured_signer
from flows.packages.flow_result import FlowResult, StepRun
from flows.packages.publish import publish
from flows.packages.report import finish_package
from steps.contract import ArtifactRef, ProvenanceRecord, StepResult
from steps.profiles import PREVIEW
from steps.store.artifact_store import ArtifactStore

MACHINE = {
    "system": "Linux",
    "processor": "Abacus 9",
    "cores": "2",
    "python": "3.11.2",
    "packages": "sha256:" + "d" * 64,
    "image": "registry.example:5000/dg4d/cpu:1.2@sha256:" + "e" * 64,
}
WEIGHTS = {"svd/unet.safetensors": "sha256:" + "c" * 64}
SOURCE = b"#?RADIANCE\na picture"
STEPS = ("prepare_subject", "drive_video", "fit_gaussians", "pack_asset")


def made_package(folder: Path, *, weights: dict[str, str] | None = None, item: str = "red fox") -> Path:
    """A package in `folder`/fox, signed if a key is configured_signer; `weights` drew the driving video."""
    store = ArtifactStore(folder / "store")
    source = store.put_bytes(SOURCE, "application/octet-stream")
    package = store.put_bytes(_zip(), "application/vnd.dg4d.package+zip")
    job = ConversionJob(item=item, source=source, profile="preview", settings=PREVIEW, seed=3, source_name="fox.png")
    made = FlowResult(package=package, steps=_steps(source, package, store, weights or {}), flow_run="run")
    signer = configured_signer()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DG4D_CODE_VERSION", "test")  # quicker than reading the source
        publish(
            store.path(package),
            folder / "fox",
            lambda staging, files: finish_package(staging, files, job, made, store, signer),
        )
    return folder / "fox"


def picture() -> bytes:
    content = io.BytesIO()
    Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3)).save(content, "PNG")
    return content.getvalue()


def record_in(folder: Path) -> dict[str, Any]:
    record: dict[str, Any] = json.loads((folder / "provenance.json").read_text())
    return record


def _zip() -> bytes:
    content = io.BytesIO()
    files = {
        "asset.glb": b"mesh",
        "contact_sheet.png": picture(),
        "asset.json": b"{}",
        "input/subject.png": picture(),
        "splats/000.ply": b"a cloud",
    }
    with zipfile.ZipFile(content, "w") as archive:
        for name, body in files.items():
            archive.writestr(zipfile.ZipInfo(name), body)
    return content.getvalue()


def _steps(source: ArtifactRef, package: ArtifactRef, store: ArtifactStore, weights: dict[str, str]) -> list[StepRun]:
    finished, given = [], source
    for number, step in enumerate(STEPS):
        out = package if step == "pack_asset" else store.put_bytes(f"out of {step}".encode(), "image/png")
        record = ProvenanceRecord(
            step=step,
            code_version="0.1.0+abc",
            request_digest=f"sha256:{number:064x}",
            inputs={"in": given.digest},
            outputs={"out": out.digest},
            settings={"size": 256, "share": 0.5},
            seed=3,
            backend="cpu",
            weights=weights if step == "drive_video" else {},
            licenses={"svd": "Some License: with terms"} if weights and step == "drive_video" else {},
            notes=("Noted.",),
            started=f"2026-11-22T10:00:0{number}.500+00:00",
            duration_s=1.25,
            peak_memory_mb=100.0,
            machine=MACHINE,
        )
        finished.append(
            StepRun(label=step, cached=False, wall_s=1.3, result=StepResult(outputs={"out": out}, provenance=record))
        )
        given = out
    return finished
