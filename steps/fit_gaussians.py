"""Step that fits static 3D Gaussians to one cut-out picture."""

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.fitting.losses import Diverged
from dg4d_lib.fitting.static import fit_gaussians
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.initialize import blob, on_surface
from dg4d_lib.gaussians.ply import write_ply
from dg4d_lib.inflation.surface import inflate, sample_surface
from dg4d_lib.rasterizer.interface import choose_rasterizer, device_of
from dg4d_lib.settings import GeometricPriorSettings, PriorSettings, StaticSettings
from steps.artifacts.media import read_png, write_png
from steps.fitting.priors import make_prior
from steps.fitting.reconstruction import reconstruct_subject
from steps.fitting.reporting import LossCurves, render_turnaround
from steps.profiles import FitGaussiansSettings
from steps.runtime.job import Job, StepReport


def run(job: Job) -> StepReport:
    """Fit the Gaussians and render them from six sides."""
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
    curves = LossCurves(static.iterations, job.progress)
    try:
        gaussians = fit_gaussians(start, subject, chosen.prior, rasterize, static, generator, curves.add)
    except Diverged as error:
        write_png(job.pictures / "last_good_state.png", render_turnaround(error.gaussians, rasterize))
        raise
    facts = chosen.facts(f"{settings.rasterizer} rasterizer")
    facts = reconstruction.added_to(facts) if reconstruction else facts
    write_ply(job.outputs["gaussians"], gaussians)
    curves.write(job.outputs["curves"], "static fit", facts.notes)
    write_png(job.outputs["picture"], render_turnaround(gaussians, rasterize))
    return facts


def touched_up(static: StaticSettings) -> StaticSettings:
    """Return settings for a start that is nearly right: a tenth of the learning rate of means (public code)."""
    rates = {"mean_rate": static.mean_rate / 10, "mean_rate_end": static.mean_rate_end / 10}
    return static.model_copy(update=rates)


def starting_cloud(
    subject: Float[Tensor, "h w 4"], static: StaticSettings, prior: PriorSettings, generator: torch.Generator
) -> Gaussians:
    """Return the cloud at iteration 0: a random blob, or points on the surface inflated from the picture."""
    if static.start == "blob":
        return blob(static.points, static.blob_radius, generator)
    shape = prior if isinstance(prior, GeometricPriorSettings) else GeometricPriorSettings()
    surface = inflate(subject, shape.size, shape.turn_deg)
    points, _, colors, area = sample_surface(surface, static.points, generator)
    return on_surface(points, colors, area)
