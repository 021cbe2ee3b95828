"""Remarks on a cut-out that the user should read before the conversion continues, and previews of the static splats."""

import os
import re
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from flows import home
from flows.engine.events import StepEvent, emit
from flows.formatting.escaping import visible
from flows.packages.acceptance import format_bounds, format_value
from flows.packages.view import viewer_of_splats
from steps.contract import ArtifactRef, StepResult
from steps.store.artifact_store import ArtifactMissing, StoreUnreachable
from steps.store.files import DiskFull, room_for

REMARKED = "prepare_subject"  # the cut-out may be wrong
COMPARED = "prepare_views"  # a view may contradict the others
GENERATED = "generate_views"  # a view may contradict the others
LOOKED_AT = "fit_gaussians"
FIRST_LOOK = "first_look"  # its output: web splats
CAPTIONS = {
    REMARKED: "Source, matte and cut-out",
    COMPARED: "Views and their visual hull",
    GENERATED: "Generated views and their visual hull",
}
GATES = "cutout_gates"  # output of `prepare_subject` with the gates of an estimated cut-out
NAME_LENGTH = 80  # characters of an item in the name of a picture
DIGITS = 12  # of a digest in it
MOST_PICTURES, MOST_PAGES = 200, 20  # kept files, the newest; they show private input


def remark(item: str, label: str, result: StepResult) -> None:
    """Emit notes and failed gates of a cut-out, or notes of views, with the path of their picture; or a preview."""
    step, notes = result.provenance.step, result.provenance.notes
    if step == LOOKED_AT and FIRST_LOOK in result.outputs:
        if page := _saved_page(item, result.outputs[FIRST_LOOK]):
            emit(StepEvent(item, label, "remark", text=f"Preview of the static splats: {page}"))
        return
    if step not in CAPTIONS or (step == COMPARED and not notes):
        return
    picture = _saved(item, result.outputs["picture"]) if "picture" in result.outputs else None
    look = [f"{CAPTIONS[step]}: {picture}"] if picture else []
    if text := " ".join([*notes, *_failed_gates(result), *look]):
        emit(StepEvent(item, label, "remark", text=text))


def _failed_gates(result: StepResult) -> list[str]:
    """Return a sentence for every failed gate of a cut-out."""
    if GATES not in result.outputs:
        return []
    try:
        verdict = home.store().load_json(result.outputs[GATES])
    except (OSError, ArtifactMissing, StoreUnreachable):
        return []
    return [
        f"Not accepted: {gate['name']} = {format_value(gate)}, allowed: {format_bounds(gate)}; {gate['advice']}."
        for gate in verdict["gates"]
        if not gate["passed"]
    ]


def _saved(item: str, ref: ArtifactRef) -> Path | None:
    """Write a picture under a readable name; None if that fails."""
    return _write_and_prune(
        home.cutouts() / f"{_name(item, ref)}.png", lambda path: home.store().get(ref, path), MOST_PICTURES
    )


def _saved_page(item: str, ref: ArtifactRef) -> Path | None:
    """Write the page of static splats under a readable name; None if that fails."""

    def write(path: Path) -> None:
        page = viewer_of_splats(home.store().path(ref).read_bytes(), visible(item))
        with room_for(path.parent):
            path.write_text(page, encoding="utf-8")

    return _write_and_prune(home.first_looks() / f"{_name(item, ref)}.html", write, MOST_PAGES)


def _name(item: str, ref: ArtifactRef) -> str:
    readable = re.sub(r"[^\w.-]+", "-", item)[:NAME_LENGTH]
    return f"{readable}-{ref.digest.rpartition(':')[2][:DIGITS]}"


def _write_and_prune(path: Path, write: Callable[[Path], object], most: int) -> Path | None:
    """Write a file atomically with mode 0600, and remove all but the newest ones beside it; None if that fails."""
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if path.exists():
            path.touch()  # the newest again
        else:
            descriptor, name = tempfile.mkstemp(dir=path.parent)  # mode 0600
            os.close(descriptor)
            scratch = Path(name)
            try:
                write(scratch)
                scratch.replace(path)
            finally:
                scratch.unlink(missing_ok=True)
    except (OSError, UnicodeError, ArtifactMissing, DiskFull, StoreUnreachable):
        return None
    _prune(path.parent, most)
    return path


def _prune(folder: Path, most: int) -> None:
    """Remove all but the newest files; another process may be removing the same ones."""
    ages: list[tuple[int, Path]] = []
    for path in folder.iterdir():
        with suppress(OSError):
            ages.append((path.stat().st_mtime_ns, path))
    for _, path in sorted(ages, reverse=True)[most:]:
        with suppress(OSError):
            path.unlink()
