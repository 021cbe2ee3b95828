"""Cut-outs of opaque pictures: known subjects over twenty procedural backdrops and over photographs.

Run with `python -m benchmarks.matting FOLDER` (minutes; `--json FILE` keeps the rows). FOLDER has a folder per object
with cut-outs input/NNN.png, as our data sets do. Every cut-out is composited over every backdrop and cut out again with
`subject.matting=auto`; the mask is compared with the known alpha.

Photographs with a subject of their own, such as a portrait, are ambiguous: which of the two is meant, no method can
know. They are reported apart, and no bound holds for them.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Literal

from benchmarks.measure import new_console, parser_of, write_rows  # before torch: how its threads wait

import torch  # isort: skip
from rich.table import Column, Table
from torch import Tensor

from benchmarks.backdrops import photographs, procedural
from dg4d_lib.errors import BadInput
from dg4d_lib.video.matting import matte
from dg4d_lib.video.segmentation_network import overlap
from steps.artifacts.media import read_png

LEAST_MEAN, LEAST_WORST = 0.96, 0.85  # bounds on the masks' overlap
OWN_SUBJECT = frozenset(["coffee", "rocket", "astronaut", "chelsea", "camera", "coins"])
Kind = Literal["procedural", "photograph", "photograph with a subject"]
KINDS: tuple[Kind, Kind, Kind] = ("procedural", "photograph", "photograph with a subject")


@dataclass(frozen=True)
class Row:
    """Result of one composite.

    Attributes:
        iou: overlap of the masks at alpha 0.5; 0 if no subject was found.
        soft_iou: overlap of the alphas.
        agreement: of two methods, as the gate judges it.
    """

    object: str
    backdrop: str
    kind: Kind
    method: str
    iou: float
    soft_iou: float
    agreement: float


def measure_matting(folder: Path, objects: Iterable[str] = ()) -> list[Row]:
    """Measure all objects of a folder over all backdrops.

    Args:
        folder: with a folder per object.
        objects: names to measure; empty: all.

    Raises:
        BadInput: the folder has no object with such a picture.
    """
    wanted = set(objects)
    paths = [
        path
        for place in sorted(folder.iterdir())
        if not wanted or place.name in wanted
        if (path := place / "input" / "000.png").is_file()
    ]
    if not paths:
        raise BadInput(f"{folder} has no object with a picture input/000.png; give a folder with a folder per object")
    return [row for path in paths for row in _rows(path.parts[-3], read_png(path))]


def summarize(rows: Iterable[Row]) -> dict[str, tuple[float, float]]:
    """Return the mean and the worst overlap of every kind of backdrop."""
    by_kind = {kind: [row.iou for row in rows if row.kind == kind] for kind in KINDS}
    return {kind: (fmean(values), min(values)) for kind, values in by_kind.items() if values}


def main() -> None:
    """Measure, and print a table."""
    parser = parser_of(__doc__)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="a folder per object, with input/NNN.png")
    options = parser.parse_args()
    rows = measure_matting(options.folder)
    new_console().print(table(rows))
    if options.json:
        write_rows(options.json, rows)


def table(rows: Sequence[Row]) -> Table:
    """Return overlaps by backdrop and object, and means and worst ones by kind of backdrop."""
    names = sorted({row.object for row in rows})
    title = f"overlap of the mask with the truth; bounds: mean {LEAST_MEAN}, worst {LEAST_WORST}"
    shown = Table("backdrop", *(Column(name, justify="right") for name in (*names, "mean")), title=title)
    for backdrop in dict.fromkeys(row.backdrop for row in rows):
        values = [row.iou for row in rows if row.backdrop == backdrop]
        shown.add_row(backdrop, *(f"{value:.3f}" for value in values), f"{fmean(values):.3f}")
    for kind, (mean, worst) in summarize(rows).items():
        shown.add_row(f"{kind}: mean {mean:.3f}, worst {worst:.3f}")
    return shown


def _rows(name: str, cutout: Tensor) -> list[Row]:
    size = cutout.shape[0]
    own: dict[str, Kind] = {backdrop: "procedural" for backdrop in procedural(size)}
    found = []
    for backdrop, picture in {**procedural(size), **photographs(size)}.items():
        kind: Kind = own.get(backdrop, KINDS[2] if backdrop in OWN_SUBJECT else KINDS[1])
        found.append(_measure(name, backdrop, kind, cutout, torch.from_numpy(picture).float()))
    return found


def _measure(name: str, backdrop: str, kind: Kind, cutout: Tensor, picture: Tensor) -> Row:
    color, alpha = cutout[..., :3], cutout[..., 3]
    composite = torch.round(255 * (color * cutout[..., 3:] + picture * (1 - cutout[..., 3:]))) / 255
    try:
        result = matte(composite[None])
    except BadInput:
        return Row(name, backdrop, kind, "refused", 0.0, 0.0, 0.0)
    found = result.frames[0, ..., 3]
    soft = float(torch.minimum(found, alpha).sum() / torch.maximum(found, alpha).sum())
    iou = overlap(found > 0.5, alpha > 0.5)
    return Row(name, backdrop, kind, result.method, iou, soft, result.agreement or 0.0)


if __name__ == "__main__":
    main()
