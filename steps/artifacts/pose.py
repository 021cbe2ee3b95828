"""The `pose` artifact: turn of a subject that its footage shows. Imports no torch."""

from pathlib import Path

from pydantic import Field, ValidationError

from dg4d_lib.errors import BadInput
from steps.contract import Frozen


class Pose(Frozen):
    """Pose of the subject in front of the input camera."""

    turn_deg: float | None = Field(
        ge=-60, le=60, description="turn of its plane about the vertical; see `subject.turn_deg`; null: not known"
    )


def write_pose(path: Path, pose: Pose) -> None:
    """Write a pose as JSON."""
    path.write_text(pose.model_dump_json(), encoding="utf-8")


def read_turn(path: Path | None) -> float | None:
    """Return the turn of the subject that its footage shows, degrees; None if it shows none or without a file.

    Raises:
        BadInput: the file is not a pose.
    """
    if path is None:
        return None
    try:
        return Pose.model_validate_json(path.read_bytes()).turn_deg
    except ValidationError as error:
        raise BadInput(
            f"{path.name} is not a pose of a subject ({error}); give the `pose` output of prepare_subject"
        ) from error
