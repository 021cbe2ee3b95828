"""Validity of the metric `flicker`: true videos seen from a few degrees off, against still videos.

Kept as evidence for reading `flicker` together with `temporal_error` (0 is the true motion, 1 is none).
`python -m experiments.flicker` (`--json FILE` keeps the rows) renders our own objects from the four scored views.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

from benchmarks.measure import new_console, parser_of, write_rows  # before torch: how its threads wait

import torch  # isort: skip
from jaxtyping import Float
from rich.table import Column, Table
from torch import Tensor

from benchmarks.objects.drawing import Painted
from benchmarks.objects.specimens import OBJECTS
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.images import color_over_white
from dg4d_lib.metrics.video import flicker, temporal_error

AZIMUTHS_DEG = (-75, 15, 105, 195)
ERRORS_DEG = (1, 2, 5, 10)  # azimuth errors of the true videos
FRONT = "the input view's first frame, held"
OWN = "every view's true first frame, held"
REPEATED = "the input at every view"


@dataclass(frozen=True)
class Film:
    """Frames over white, and the alpha of the subject."""

    frames: Float[Tensor, "t h w 3"]
    region: Float[Tensor, "t h w 1"]

    def held(self) -> "Film":
        """Return a still video of the first frame."""
        return Film(self.frames[:1].expand_as(self.frames), self.region[:1].expand_as(self.region))


@dataclass(frozen=True)
class Row:
    """Result of one video; means over the views."""

    object: str
    film: str
    flicker: float
    temporal_error: float


def render_cycle(painted: Painted, azimuth_deg: float, frames: int, size: int) -> Film:
    """Render one cycle of an object's motion from one azimuth."""
    camera = OrbitCamera(azimuth_deg=azimuth_deg, width=size, height=size)
    cutouts = torch.cat([painted.draw(frame / frames, [camera]) for frame in range(frames)])
    alpha = cutouts[..., 3:]
    return Film(color_over_white(cutouts[..., :3], alpha), (alpha > 0.5).float())


def measure_object(name: str, frames: int, size: int) -> list[Row]:
    """Return the results of all videos of one object."""
    painted = Painted(OBJECTS[name]())
    front = render_cycle(painted, 0, frames, size)
    figures: dict[str, list[tuple[float, float]]] = {}
    for azimuth in AZIMUTHS_DEG:
        ground_truth = render_cycle(painted, azimuth, frames, size)
        films = {
            f"ground truth, {off} degrees off": render_cycle(painted, azimuth + off, frames, size) for off in ERRORS_DEG
        }
        for film, made in {**films, OWN: ground_truth.held(), FRONT: front.held(), REPEATED: front}.items():
            region = torch.maximum(made.region, ground_truth.region)
            found = flicker(made.frames, ground_truth.frames, region), temporal_error(made.frames, ground_truth.frames)
            figures.setdefault(film, []).append((float(found[0]), float(found[1])))
    return [Row(name, film, *(fmean(column) for column in zip(*pairs, strict=True))) for film, pairs in figures.items()]


def table(rows: Sequence[Row]) -> Table:
    """Return a line per video: its flicker for every object, the mean, and the mean temporal error."""
    objects, films = (list(dict.fromkeys(getattr(row, field) for row in rows)) for field in ("object", "film"))
    result = Table(Column("film", no_wrap=True), *objects, "mean flicker", "mean temporal error")
    for film in films:
        own = [row for row in rows if row.film == film]
        means = fmean(row.flicker for row in own), fmean(row.temporal_error for row in own)
        result.add_row(film, *(f"{row.flicker:.1f}" for row in own), f"{means[0]:.1f}", f"{means[1]:.2f}")
    return result


def main() -> None:
    options = parser_of(__doc__, "one object, four frames of 48 pixels").parse_args()
    frames, size = (4, 48) if options.quick else (32, 256)
    rows = [row for name in list(OBJECTS)[: 1 if options.quick else None] for row in measure_object(name, frames, size)]
    new_console().print(table(rows))
    if options.json:
        write_rows(options.json, rows)


if __name__ == "__main__":
    main()
