"""Step that fits a deformation of static Gaussians to a driving video."""

from dataclasses import replace

import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.fitting.losses import Diverged
from dg4d_lib.fitting.motion import fit_motion
from dg4d_lib.gaussians.ply import read_ply, write_ply
from dg4d_lib.rasterizer.interface import choose_rasterizer, device_of
from steps.artifacts.media import read_frames, write_png
from steps.artifacts.motions import new_deformation, write_motion
from steps.fitting.priors import make_prior
from steps.fitting.reporting import PICTURE_SIZE, LossCurves, render_turnaround
from steps.profiles import FitMotionSettings
from steps.runtime.job import Job, StepReport

FINE_TUNED = "The Gaussians at rest were fitted to the whole video together with their motion."
PICTURE_FRAMES = 6
PICTURE_AZIMUTHS_DEG = (0.0, 90.0)


def run(job: Job) -> StepReport:
    """Fit the deformation, with `fine_tune` also the Gaussians; render six timestamps from front and side."""
    settings: FitMotionSettings = job.settings
    gaussians = read_ply(job.inputs["gaussians"])
    video = read_frames(job.inputs["driving_video"], job.pictures)
    generator = torch.Generator().manual_seed(job.seed)
    rasterize = choose_rasterizer(settings.rasterizer)
    cutouts = list(torch.cat([video.frames, video.coverage], -1))
    bank = job.inputs.get("bank")
    chosen = make_prior(settings.prior, cutouts, settings.motion, bank, job.pictures)
    deformation = new_deformation(settings.deformation, gaussians, len(video), generator)
    device = device_of(settings.rasterizer)
    deformation.to(device)
    curves = LossCurves(settings.motion.iterations, job.progress)
    try:
        fitted = fit_motion(
            gaussians.to(device), deformation, video, chosen.prior, rasterize, settings.motion, generator, curves.add
        )
    except Diverged as error:
        write_png(job.pictures / "last_good_state.png", render_turnaround(error.gaussians, rasterize))
        raise
    deformation.cpu()
    gaussians = fitted.to(torch.device("cpu"))
    if settings.motion.fine_tune:
        write_ply(job.outputs["gaussians"], gaussians)
    write_motion(job.outputs["motion"], deformation, settings.deformation, len(video), len(gaussians))
    curves.write(job.outputs["curves"], "motion fit", [chosen.note])
    with torch.no_grad():
        moments = torch.linspace(0, 1, min(PICTURE_FRAMES, len(video)))
        moved = deformation.displace(gaussians.means, moments).apply(gaussians)
        rows = []
        for azimuth in PICTURE_AZIMUTHS_DEG:
            camera = OrbitCamera(0, azimuth, width=PICTURE_SIZE, height=PICTURE_SIZE)
            rows.append(torch.cat(list(rasterize(moved, [camera] * len(moments), torch.ones(3)).color), 1))
    write_png(job.outputs["picture"], torch.cat(rows))
    facts = chosen.facts(f"{settings.rasterizer} rasterizer")
    return replace(facts, notes=(*facts.notes, FINE_TUNED)) if settings.motion.fine_tune else facts
