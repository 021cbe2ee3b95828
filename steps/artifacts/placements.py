"""The `placement` artifact: similarity from a user's model to the world, as JSON."""

from pathlib import Path

import torch
from pydantic import Field, ValidationError

from dg4d_lib.errors import BadInput
from dg4d_lib.fitting.asset_pose import Placement
from steps.contract import Frozen


class StoredPlacement(Frozen):
    """Placement of a model; see `dg4d_lib.fitting.asset_pose.Placement`."""

    quat: tuple[float, float, float, float] = Field(description="rotation, wxyz")
    scale: float = Field(gt=0)
    shift: tuple[float, float, float]
    azimuth_deg: float
    agreement: float
    color_error: float
    posed: bool


def write_placement(path: Path, placement: Placement) -> None:
    """Write a placement; floats keep every bit."""
    stored = StoredPlacement.model_validate(
        {**vars(placement), "quat": placement.quat.tolist(), "shift": placement.shift.tolist()}
    )
    path.write_text(stored.model_dump_json(), encoding="utf-8")


def read_placement(path: Path) -> Placement:
    """Read a file of `write_placement`.

    Raises:
        BadInput: the file is not a placement.
    """
    try:
        stored = StoredPlacement.model_validate_json(path.read_bytes())
    except ValidationError as error:
        raise BadInput(
            f"{path.name} is not a placement ({error}); give the `placement` output of prepare_asset"
        ) from error
    values = stored.model_dump()
    return Placement(**{**values, "quat": torch.tensor(stored.quat), "shift": torch.tensor(stored.shift)})
