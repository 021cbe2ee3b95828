"""The `plan` artifact: tracked mesh or mesh per frame, and the density of its surface. Imports no torch."""

from pathlib import Path
from typing import Literal

from pydantic import Field, NonNegativeInt, ValidationError

from dg4d_lib.errors import BadInput
from steps.contract import Frozen


class MeshPlan(Frozen):
    """Decisions that `plan_mesh` makes, or `extract_mesh` that gives one mesh up, and `extract_mesh` carries out."""

    mode: Literal["tracked", "per_frame"]
    reference_frame: int = Field(0, ge=0, description="frame whose surface is extracted (tracked) or sets the level")
    other_candidates: tuple[NonNegativeInt, ...] = Field((), description="other frames whose surfaces are also tracked")
    followed: float = Field(1.0, description="IoU of outlines over the motion, of the best trial mesh; 1 if none")
    level: float = Field(description="density of the surface")
    grid: int | None = Field(None, ge=16, le=512, description="cells of the density field per axis; none: `mesh.grid`")
    guide: Literal["gaussians", "video"] = Field(
        "gaussians", description="motion that the vertices of a tracked mesh follow"
    )


def write_plan(path: Path, plan: MeshPlan) -> None:
    """Write a plan as JSON; floats keep every bit."""
    path.write_text(plan.model_dump_json(), encoding="utf-8")


def read_plan(path: Path) -> MeshPlan:
    """Read a file of `write_plan`.

    Raises:
        BadInput: the file is not a plan.
    """
    try:
        return MeshPlan.model_validate_json(path.read_bytes())
    except ValidationError as error:
        raise BadInput(f"{path.name} is not a plan of a mesh ({error}); give the `plan` output of plan_mesh") from error
