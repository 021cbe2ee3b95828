"""Jobs of fake steps, the steps that ran, and the files that they wrote."""

from collections.abc import Callable
from pathlib import Path

from fake_steps import picture
from typer.testing import Result

from flows import home
from flows.engine.versions import faults, versions
from flows.inputs.conversion_job import ConversionJob, ConversionRequest
from steps.profiles import PREVIEW, revise

Run = Callable[..., Result]  # the command `dg4d`, in this process
EVERY_STEP = [
    "prepare_subject", "drive_video", "fit_gaussians", "fit_motion", "plan_mesh", "extract_mesh", "pack_asset",
    "check_asset",
]  # fmt: skip
RUN_FACTS = ("report.json", "report.html", "provenance.json", "ro-crate-metadata.json")  # these say when and how long


def ran(log: Path) -> list[str]:
    steps = log.read_text().split() if log.exists() else []
    log.unlink(missing_ok=True)
    return steps


def job(words: str, folder: Path, *, name: str = "fake.png", item: str = "fake", **changes: object) -> ConversionJob:
    (folder / name).write_text(picture(words))
    return ConversionRequest(item=item, picture=folder / name, settings=revise(PREVIEW, dict(changes))).to_job(
        home.store()
    )


def store_is_sound() -> bool:
    """Return true if all artifacts of all versions are in the store and intact."""
    store = home.store()
    return not faults(store, versions(store), {entry.name: entry.size_bytes for entry in store.artifacts()})


def tree(folder: Path, *but: str) -> dict[str, bytes]:
    files = (p for p in sorted(folder.rglob("*")) if p.is_file() and p.name not in but)
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in files}
