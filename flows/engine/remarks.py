"""Remarks on a cut-out that the user should read before the conversion goes on, with a picture."""

import json
import os
import re
import tempfile
from contextlib import suppress
from pathlib import Path

from flows import home
from flows.engine.events import StepEvent, emit
from flows.packages.acceptance import format_bounds, format_value
from steps.contract import ArtifactRef, StepResult
from steps.store.artifact_store import ArtifactMissing, StoreUnreachable
from steps.store.files import DiskFull

REMARKED = "prepare_subject"  # the cut-out may be wrong
COMPARED = "prepare_views"  # a view may contradict the others
DRAWN = "generate_views"  # likewise
CAPTIONS = {
    REMARKED: "Source, matte and cut-out",
    COMPARED: "Views, and the hull that they share",
    DRAWN: "Drawn views, and the hull that they share",
}
GATES = "cutout_gates"  # output of `prepare_subject` with the gates of an estimated cut-out
NAME_LENGTH = 80  # characters of an item in the name of a picture
DIGITS = 12  # of a digest in it
MOST_PICTURES = 200  # kept files, the newest; they show private input


def remark(item: str, label: str, result: StepResult) -> None:
    """Emit the notes and failed gates of a cut-out, or the notes of views, with the path of their picture."""
    step, notes = result.provenance.step, result.provenance.notes
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
        verdict = json.loads(home.store().path(result.outputs[GATES]).read_text(encoding="utf-8"))
    except (OSError, ArtifactMissing, StoreUnreachable):
        return []
    return [
        f"Not accepted: {gate['name']} is {format_value(gate)}, allowed is {format_bounds(gate)}; {gate['advice']}."
        for gate in verdict["gates"]
        if not gate["passed"]
    ]


def _saved(item: str, ref: ArtifactRef) -> Path | None:
    """Write a picture under a readable name; None if that fails."""
    name = re.sub(r"[^\w.-]+", "-", item)[:NAME_LENGTH]
    path = home.cutouts() / f"{name}-{ref.digest.rpartition(':')[2][:DIGITS]}.png"
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if path.exists():
            path.touch()  # the newest again
        else:
            _fetch(ref, path)
    except (OSError, UnicodeError, ArtifactMissing, DiskFull, StoreUnreachable):
        return None
    _prune(path.parent)
    return path


def _fetch(ref: ArtifactRef, path: Path) -> None:
    """Copy an artifact atomically into a file with mode 0600."""
    descriptor, name = tempfile.mkstemp(dir=path.parent)  # mode 0600
    os.close(descriptor)
    scratch = Path(name)
    try:
        home.store().get(ref, scratch)
        scratch.replace(path)
    finally:
        scratch.unlink(missing_ok=True)


def _prune(folder: Path) -> None:
    """Remove all but the newest pictures; another process may be removing the same ones."""
    ages: list[tuple[int, Path]] = []
    for path in folder.iterdir():
        with suppress(OSError):
            ages.append((path.stat().st_mtime_ns, path))
    for _, path in sorted(ages, reverse=True)[MOST_PICTURES:]:
        with suppress(OSError):
            path.unlink()
