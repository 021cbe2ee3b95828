"""From one cut-out picture to static 3D Gaussians."""

from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.fitting.losses import Diverged
from dg4d_lib.fitting.static import fit_gaussians
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.initialize import blob, on_surface
from dg4d_lib.gaussians.ply import write_ply
from dg4d_lib.inflation.surface import inflate, sample_surface
from dg4d_lib.rasterizer.interface import Rasterizer, choose_rasterizer, device_of
from dg4d_lib.settings import GeometricPriorSettings, PriorSettings, StaticSettings
from steps.artifacts.media import read_png, write_curves, write_png
from steps.fitting.priors import make_prior
from steps.fitting.reconstruction import reconstruct_subject
from steps.profiles import FitGaussiansSettings
from steps.runtime.job import Facts, Job

PICTURE_AZIMUTHS_DEG = (0.0, 45.0, 90.0, 180.0, -90.0, -45.0)
PICTURE_SIZE = 192  # pixels


def run(job: Job) -> Facts:
    """Fit, and show the result from six sides."""
    settings: FitGaussiansSettings = job.settings
    subject = read_png(job.inputs["subject"])
    generator = torch.Generator().manual_seed(job.seed)
    rasterize = choose_rasterizer(settings.rasterizer)
    bank = job.inputs.get("bank")
    device = device_of(settings.rasterizer)
    static, reconstruction = settings.static, None
    if static.lgm is None:
        start = starting_cloud(subject, static, settings.prior, generator).to(device)
    else:
        reconstruction = reconstruct_subject(subject.to(device), static.lgm, rasterize, generator)
        start, static = reconstruction.gaussians, touched_up(static)
    chosen = make_prior(settings.prior, [subject], static, bank, job.pictures)
    curves = Curves(static.iterations, job.progress)
    try:
        gaussians = fit_gaussians(start, subject, chosen.prior, rasterize, static, generator, curves.add)
    except Diverged as error:
        write_png(job.pictures / "last_good_state.png", picture_of(error.gaussians, rasterize))
        raise
    facts = chosen.facts(f"{settings.rasterizer} rasterizer")
    facts = reconstruction.added_to(facts) if reconstruction else facts
    write_ply(job.outputs["gaussians"], gaussians)
    curves.write(job.outputs["curves"], "static fit", facts.notes)
    write_png(job.outputs["picture"], picture_of(gaussians, rasterize))
    return facts


def touched_up(static: StaticSettings) -> StaticSettings:
    """The settings of a fit whose cloud is nearly right already: its means move a tenth as fast (public code)."""
    rates = {"mean_rate": static.mean_rate / 10, "mean_rate_end": static.mean_rate_end / 10}
    return static.model_copy(update=rates)


def starting_cloud(
    subject: Float[Tensor, "h w 4"], static: StaticSettings, prior: PriorSettings, generator: torch.Generator
) -> Gaussians:
    """The cloud at iteration 0: the random blob, or points on the surface inflated from the picture."""
    if static.start == "blob":
        return blob(static.points, static.blob_radius, generator)
    shape = prior if isinstance(prior, GeometricPriorSettings) else GeometricPriorSettings()
    surface = inflate(subject, shape.size, shape.turn_deg)
    points, _, colors, area = sample_surface(surface, static.points, generator)
    return on_surface(points, colors, area)


class Curves:
    """Collects what a loop reports, passes it on as progress, and writes it."""

    def __init__(self, total: int, progress: Callable[[int, int, dict[str, float]], None]) -> None:
        self.total, self.progress = total, progress
        self.iterations: list[int] = []
        self.series: dict[str, list[float]] = {}

    def add(self, iteration: int, values: dict[str, float]) -> None:
        """One iteration is done."""
        self.iterations.append(iteration)
        for name, value in values.items():
            self.series.setdefault(name, []).append(value)
        self.progress(iteration, self.total, values)

    def write(self, path: Path, title: str, notes: Sequence[str]) -> None:
        """As the `curves` artifact."""
        write_curves(path, title, self.iterations, self.series, notes)


def picture_of(gaussians: Gaussians, rasterize: Rasterizer) -> Float[Tensor, "h w 3"]:
    """The cloud from six sides in a row, over white."""
    cameras = [OrbitCamera(0, azimuth, width=PICTURE_SIZE, height=PICTURE_SIZE) for azimuth in PICTURE_AZIMUTHS_DEG]
    with torch.no_grad():
        return torch.cat(list(rasterize(gaussians, cameras, torch.ones(3)).color), 1).cpu()
