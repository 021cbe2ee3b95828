"""Writer of view banks: `bank.json` and a sheet of tiles per view, in the format of `steps.sources.banks`."""

import json
import math
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.visual_hull.known import KnownView
from steps.artifacts.media import write_png, write_zip
from steps.sources.banks import BANK_JSON


def write_bank(path: Path, views_by_frame: Sequence[Sequence[KnownView]], scratch: Path) -> None:
    """Write views of consecutive frames, from frame 0, as a zip.

    Args:
        path: zip to write.
        views_by_frame: views by frame; the same cameras in every frame, square pictures of one size.
        scratch: folder for a picture.
    """
    columns = math.ceil(math.sqrt(len(views_by_frame)))
    rows = math.ceil(len(views_by_frame) / columns)
    sheets, views = [], []
    for number, view in enumerate(views_by_frame[0]):
        name = f"{number:03d}.png"
        write_png(scratch / name, _sheet([frame[number].cutout for frame in views_by_frame], rows, columns))
        sheets.append((name, (scratch / name).read_bytes()))
        (scratch / name).unlink()
        camera = view.camera
        views.append(
            {
                "file": name,
                "azimuth": camera.azimuth_deg,
                "elevation": camera.elevation_deg,
                "radius": camera.radius,
                "weight": view.weight,
                "name": view.name,
            }
        )
    size = views_by_frame[0][0].camera.width
    index = {"frames": list(range(len(views_by_frame))), "tile": [rows, columns], "tile_size": size, "views": views}
    write_zip(path, [(BANK_JSON, json.dumps(index, indent=1).encode()), *sheets])


def _sheet(cutouts: Sequence[Float[Tensor, "s s 4"]], rows: int, columns: int) -> Float[Tensor, "h w 4"]:
    empty = torch.zeros_like(cutouts[0])
    tiles = [*cutouts, *[empty] * (rows * columns - len(cutouts))]
    return torch.cat([torch.cat(tiles[row * columns : (row + 1) * columns], 1) for row in range(rows)])
