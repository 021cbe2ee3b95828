"""Loss curves and renders of fits."""

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.fitting.losses import Diverged
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.rasterizer.interface import Rasterizer
from steps.artifacts.media import write_png
from steps.runtime.job import Job, Progress

TURNAROUND_AZIMUTHS_DEG = (0.0, 45.0, 90.0, 180.0, -90.0, -45.0)
SHOWN_AZIMUTHS_DEG = (0.0, 60.0, 180.0)  # of a fit that runs
PICTURE_SIZE = 192  # pixels
CURVE_POINTS = 200


class LossCurves:
    """Losses of an optimization, passed on as progress and written as an artifact.

    Args:
        total: number of iterations.
        progress: callback of the job.
    """

    def __init__(self, total: int, progress: Progress) -> None:
        self.total, self.progress = total, progress
        self.iterations: list[int] = []
        self.series: dict[str, list[float]] = {}

    def add(self, iteration: int, values: dict[str, float]) -> None:
        """Record the losses of an iteration."""
        self.iterations.append(iteration)
        for name, value in values.items():
            self.series.setdefault(name, []).append(value)
        self.progress(iteration, self.total, values)

    def write(self, path: Path, title: str, notes: Sequence[str]) -> None:
        """Write the `curves` artifact, subsampled to about `CURVE_POINTS` points."""
        step = max(1, len(self.iterations) // CURVE_POINTS)
        series = {name: [round(float(v), 6) for v in values[::step]] for name, values in self.series.items()}
        curves = {"title": title, "x": self.iterations[::step], "series": series, "notes": list(notes)}
        path.write_text(json.dumps(curves), encoding="utf-8")


@contextmanager
def picture_of_divergence(job: Job, rasterize: Rasterizer) -> Iterator[None]:
    """Save a render of the last good state if the fit in the block diverges."""
    try:
        yield
    except Diverged as error:
        write_png(job.pictures / "last_good_state.png", render_turnaround(error.gaussians, rasterize))
        raise


def show_fit(job: Job, state: Callable[[], Gaussians], rasterize: Rasterizer) -> None:
    """Offer a picture of a fit that runs.

    Args:
        job: of the step.
        state: returns the Gaussians as they are now; called only if a picture is due.
        rasterize: rasterizer.
    """

    def draw() -> bytes:
        path = job.outputs["picture"].with_name("live.png")
        with torch.no_grad():
            write_png(path, render_row(state(), SHOWN_AZIMUTHS_DEG, rasterize))
        return path.read_bytes()

    job.show(draw)


def render_turnaround(gaussians: Gaussians, rasterize: Rasterizer) -> Float[Tensor, "h w 3"]:
    """Render Gaussians from six sides in a row, over white."""
    return render_row(gaussians, TURNAROUND_AZIMUTHS_DEG, rasterize)


def render_row(gaussians: Gaussians, azimuths_deg: Sequence[float], rasterize: Rasterizer) -> Float[Tensor, "h w 3"]:
    """Render one state from several azimuths, or one state per azimuth, in a row over white."""
    cameras = [OrbitCamera(0, azimuth, width=PICTURE_SIZE, height=PICTURE_SIZE) for azimuth in azimuths_deg]
    with torch.no_grad():
        return torch.cat(list(rasterize(gaussians, cameras, torch.ones(3)).color), 1).cpu()
