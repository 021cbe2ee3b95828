"""Step that fits static 3D Gaussians to one cut-out picture."""

from dataclasses import replace

import torch

from dg4d_lib.assets.formats.web_splats import write_web_splats
from dg4d_lib.fitting.static import fit_gaussians
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.initialize import blob, on_surface
from dg4d_lib.gaussians.ply import write_ply
from dg4d_lib.guidance.interface import SubjectShapes
from dg4d_lib.guidance.learned import LearnedShapes
from dg4d_lib.inflation.surface import sample_surface
from dg4d_lib.rasterizer.interface import get_rasterizer, preferred_device
from dg4d_lib.reconstruction.lgm import WORLD_SCALE
from dg4d_lib.settings import (
    BlobStartSettings,
    LgmStartSettings,
    PriorSettings,
    StaticSettings,
    SurfaceStartSettings,
)
from steps.artifacts.media import read_png, write_png
from steps.fitting.priors import known_views, make_prior, read_known_views, subject_hint, subject_shapes
from steps.fitting.reconstruction import reconstruct_subject
from steps.fitting.reporting import LossCurves, picture_of_divergence, render_turnaround, show_fit
from steps.runtime.job import Job, StepReport

BLOB_RADIUS = 0.5  # world units
INFLATED_POINTS, PREDICTED_POINTS = 5000, 8000  # the input view of a predicted surface gains 1 dB from 3,000 more


def run(job: Job) -> StepReport:
    """Fit the Gaussians and render them from six sides."""
    static: StaticSettings = job.settings.static
    prior: PriorSettings = job.settings.prior
    backend = job.settings.rasterizer
    pose = job.inputs.get("pose") if "known_views" not in job.inputs else None
    hint = subject_hint(prior, pose, job.inputs.get("depth_field"), job.settings.turn_deg)
    subject = read_png(job.inputs["subject"])
    generator = torch.Generator().manual_seed(job.seed)
    rasterize = get_rasterizer(backend)
    device = preferred_device(backend)
    known = read_known_views(job.inputs.get("known_views"), job.pictures)
    reconstruction = None
    if isinstance(static.start, LgmStartSettings):  # before the prior, so that two networks are not in memory at once
        reconstruction = reconstruct_subject(subject.to(device), static.start, rasterize, generator)
        static = fine_tuning_settings(static)
    step_prior = make_prior(prior, [subject], static, job.inputs.get("bank"), job.pictures, hint, known)
    others = known_views(known) if known is not None else []
    if reconstruction:
        start = reconstruction.gaussians
    else:
        shapes = step_prior.shapes or subject_shapes(prior, [subject], hint, known)
        start = initial_gaussians(job.settings.static.start, shapes, generator).to(device)
    curves = LossCurves(static.iterations, job.progress)

    def watch(now: Gaussians) -> None:
        show_fit(job, now.detach, rasterize)

    with picture_of_divergence(job, rasterize), step_prior.threads():
        gaussians = fit_gaussians(
            start, subject, step_prior.prior, rasterize, static, generator, curves.add, known=others, watch=watch
        )
    report = step_prior.report(f"{backend} rasterizer")
    report = reconstruction.add_to(report) if reconstruction else report
    write_ply(job.outputs["gaussians"], gaussians)
    job.outputs["first_look"].write_bytes(write_web_splats(one_state(gaussians), fps=1))
    curves.write(job.outputs["curves"], "static fit", report.notes)
    write_png(job.outputs["picture"], render_turnaround(gaussians, rasterize))
    return report


def one_state(gaussians: Gaussians) -> Gaussians:
    """Return a batch of one state."""
    return replace(
        gaussians, means=gaussians.means[None], log_scales=gaussians.log_scales[None], quats=gaussians.quats[None]
    )


def fine_tuning_settings(static: StaticSettings) -> StaticSettings:
    """Return settings for reconstructed Gaussians: a tenth of the learning rate of the means, as DG4D's public code.

    Its rate belongs to LGM's own lengths, so it grows with these.
    """
    factor = WORLD_SCALE / 10
    return static.model_copy(
        update={"means_lr": factor * static.means_lr, "means_lr_end": factor * static.means_lr_end}
    )


def initial_gaussians(
    start: BlobStartSettings | SurfaceStartSettings, shapes: SubjectShapes, generator: torch.Generator
) -> Gaussians:
    """Initialize Gaussians as a random blob, or as points on the surface of the first frame."""
    if isinstance(start, BlobStartSettings):
        return blob(start.points, BLOB_RADIUS, generator)
    count = start.points or (PREDICTED_POINTS if isinstance(shapes, LearnedShapes) else INFLATED_POINTS)
    points, _, colors, area = sample_surface(shapes.surface(0), count, generator)
    return on_surface(points, colors, area)
