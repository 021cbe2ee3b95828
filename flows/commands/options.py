"""Options that several commands share."""

import math
from typing import Annotated, Any

import typer


def finite(value: float | None) -> float | None:
    """Refuse NaN, which lies in every range because no comparison with it is true, and infinity."""
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"{value} is not a finite number")
    return value


Profile = Annotated[str, typer.Option(help="named settings to start from")]
Changes = Annotated[
    list[str] | None, typer.Option("--set", metavar="KNOB=VALUE", help="change a knob; may be repeated")
]
Commercial = Annotated[
    bool, typer.Option("--commercial-only", help="refuse weights whose license forbids commercial use")
]
LARGEST_SEED = 2**63 - 1  # as in steps/contract.py, whose import would bring pydantic
Seed = Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="of everything random; equal seeds give equal bytes")]
Triangles = Annotated[int | None, typer.Option(help="of the mesh, at most; short for --set mesh.max_faces=")]
Texture = Annotated[int | None, typer.Option("--texture", help="texels of a side; short for --set mesh.texture_size=")]
Rate = Annotated[
    float | None,
    typer.Option(
        "--fps", min=1, max=240, callback=finite, help="frames per second of the files; short for --set pack.fps="
    ),
]


def knobs_of(triangles: int | None, texture: int | None, fps: float | None) -> dict[str, Any]:
    """The knobs behind options that are short for them."""
    given = {"mesh.max_faces": triangles, "mesh.texture_size": texture, "pack.fps": fps}
    return {knob: value for knob, value in given.items() if value is not None}
