"""Step that fits static 3D Gaussians to one cut-out picture."""

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.fitting.losses import Diverged
from dg4d_lib.fitting.static import fit_gaussians
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.initialize import blob, on_surface
from dg4d_lib.gaussians.ply import write_ply
from dg4d_lib.inflation.surface import sample_surface
from dg4d_lib.rasterizer.interface import choose_rasterizer, device_of
from dg4d_lib.settings import (
    BlobStartSettings,
    LgmStartSettings,
    PriorSettings,
    StaticSettings,
    SurfaceStartSettings,
)
from steps.artifacts.media import read_png, write_png
from steps.artifacts.pose import read_turn
from steps.fitting.priors import make_prior, subject_shapes
from steps.fitting.reconstruction import reconstruct_subject
from steps.fitting.reporting import LossCurves, render_turnaround
from steps.runtime.job import Job, StepReport

BLOB_RADIUS = 0.5  # world units


def run(job: Job) -> StepReport:
    """Fit the Gaussians and render them from six sides."""
    prior: PriorSettings = job.settings.prior
    static: StaticSettings = job.settings.static
    backend, turn_deg = job.settings.rasterizer, read_turn(job.inputs.get("pose"), job.settings.turn_deg)
    subject = read_png(job.inputs["subject"])
    generator = torch.Generator().manual_seed(job.seed)
    rasterize = choose_rasterizer(backend)
    device = device_of(backend)
    reconstruction = None
    if isinstance(static.start, LgmStartSettings):
        reconstruction = reconstruct_subject(subject.to(device), static.start, rasterize, generator)
        start, static = reconstruction.gaussians, touched_up(static)
    else:
        start = starting_cloud(subject, static.start, prior, turn_deg, generator).to(device)
    chosen = make_prior(prior, [subject], static, job.inputs.get("bank"), job.pictures, turn_deg)
    curves = LossCurves(static.iterations, job.progress)
    try:
        gaussians = fit_gaussians(start, subject, chosen.prior, rasterize, static, generator, curves.add)
    except Diverged as error:
        write_png(job.pictures / "last_good_state.png", render_turnaround(error.gaussians, rasterize))
        raise
    facts = chosen.facts(f"{backend} rasterizer")
    facts = reconstruction.added_to(facts) if reconstruction else facts
    write_ply(job.outputs["gaussians"], gaussians)
    curves.write(job.outputs["curves"], "static fit", facts.notes)
    write_png(job.outputs["picture"], render_turnaround(gaussians, rasterize))
    return facts


def touched_up(static: StaticSettings) -> StaticSettings:
    """Return settings for a cloud that is nearly right already: its means move a tenth as fast (public code)."""
    rates = {"means_lr": static.means_lr / 10, "means_lr_end": static.means_lr_end / 10}
    return static.model_copy(update=rates)


def starting_cloud(
    subject: Float[Tensor, "h w 4"],
    start: BlobStartSettings | SurfaceStartSettings,
    prior: PriorSettings,
    turn_deg: float,
    generator: torch.Generator,
) -> Gaussians:
    """Make the cloud of iteration 0: the random blob, or points on the surface of the prior."""
    if isinstance(start, BlobStartSettings):
        return blob(start.points, BLOB_RADIUS, generator)
    surface = subject_shapes(prior, [subject], turn_deg).surface(0)
    points, _, colors, area = sample_surface(surface, start.points, generator)
    return on_surface(points, colors, area)
