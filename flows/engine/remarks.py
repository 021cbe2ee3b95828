"""Remarks on a result that a user should read before the rest of the run, with a picture to look at."""

import re
from pathlib import Path

from flows import home
from flows.engine.events import StepEvent, tell
from steps.contract import ArtifactRef, StepResult
from steps.store import ArtifactMissing, StoreUnreachable

REMARKED = "prepare_subject"  # cuts subjects out, which may be a guess
NAME_LENGTH = 80  # characters of an item in the name of a picture
DIGITS = 12  # of a digest in it


def remark(item: str, label: str, result: StepResult) -> None:
    """Emit the notes of a cut-out, and a file in which source, matte and cut-out stand side by side."""
    notes = result.provenance.notes
    if result.provenance.step != REMARKED or not notes:
        return
    picture = _saved(item, result.outputs["picture"]) if "picture" in result.outputs else None
    look = [f"Source, matte and cut-out: {picture}"] if picture else []
    tell(StepEvent(item, label, "remark", text=" ".join([*notes, *look])))


def _saved(item: str, ref: ArtifactRef) -> Path | None:
    """Write a picture where people can open it by its name; None if that fails."""
    name = re.sub(r"[^\w.-]+", "-", item)[:NAME_LENGTH]
    path = home.cutouts() / f"{name}-{ref.digest.rpartition(':')[2][:DIGITS]}.png"
    try:
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            home.store().get(ref, path)
    except (OSError, UnicodeError, ArtifactMissing, StoreUnreachable):
        return None
    return path
