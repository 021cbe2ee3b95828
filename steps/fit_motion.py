"""Step that fits a deformation of static Gaussians to a driving video."""

from dataclasses import replace

import torch

from dg4d_lib.deformation.factory import AnyDeformation, deformation_of_subset
from dg4d_lib.fitting.motion import fit_motion
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.ply import read_ply, write_ply
from dg4d_lib.gaussians.strays import find_strays
from dg4d_lib.rasterizer.interface import get_rasterizer, preferred_device
from dg4d_lib.settings import DeformationSettings, MotionSettings
from steps.artifacts.media import read_frames, write_png
from steps.artifacts.motions import new_deformation, write_motion
from steps.fitting.priors import make_prior, read_known_views, still_views, subject_hint
from steps.fitting.reporting import SHOWN_AZIMUTHS_DEG, LossCurves, picture_of_divergence, render_row, show_fit
from steps.fitting.tracking import TRACKED_NOTE, SurfaceTracker, most_iterations, tracks_surface
from steps.runtime.job import Job, StepReport

STRAYS = "Stray Gaussians that separated from the moving subject were removed: {}."
FINE_TUNED = "The canonical Gaussians were optimized together with the deformation, on all frames."
PICTURE_FRAMES = 6
STATES = 16  # states in memory at once during the search for strays
FRONT_DEG, SIDE_DEG = 0.0, 90.0


def run(job: Job) -> StepReport:
    """Fit the deformation, with `fine_tune` also the Gaussians; drop strays; render six timestamps of two sides."""
    backend, prior = job.settings.rasterizer, job.settings.prior
    pose = job.inputs.get("pose") if "known_views" not in job.inputs else None
    hint = subject_hint(prior, pose, job.inputs.get("depth_field"), job.settings.turn_deg)
    kind: DeformationSettings = job.settings.deformation
    settings: MotionSettings = job.settings.motion
    gaussians = read_ply(job.inputs["gaussians"])
    video = read_frames(job.inputs["driving_video"], job.pictures)
    generator = torch.Generator().manual_seed(job.seed)
    rasterize = get_rasterizer(backend)
    cutouts = list(torch.cat([video.frames, video.alpha], -1))
    known = read_known_views(job.inputs.get("known_views"), job.pictures)
    tracked = known if tracks_surface(settings, prior, known, len(video)) else None
    before = most_iterations(tracked, video, settings.trackings) if tracked else 0
    curves = LossCurves(before + settings.iterations, job.progress)
    track = None
    if tracked:
        track = SurfaceTracker(gaussians, video, tracked, rasterize, generator, settings.trackings, curves.add)
    with picture_of_divergence(job, rasterize):
        step_prior = make_prior(prior, cutouts, settings, job.inputs.get("bank"), job.pictures, hint, known, track)
    field = new_deformation(kind, gaussians, len(video), generator)
    deformation = track.hinged.carrying(field, gaussians) if track and track.hinged else field
    device = preferred_device(backend)
    deformation.to(device)
    start = gaussians.to(device)
    shown_times = torch.linspace(0, 1, len(SHOWN_AZIMUTHS_DEG) + 1)[:-1].to(device)  # one for each side

    def watch(iteration: int, values: dict[str, float]) -> None:
        curves.add(before + iteration, values)
        show_fit(job, lambda: deformation.displace(start.means, shown_times).apply(start), rasterize)

    with picture_of_divergence(job, rasterize), step_prior.threads():
        others = still_views(known, len(video))
        fitted = fit_motion(
            start, deformation, video, step_prior.prior, rasterize, settings, generator, watch, known=others
        )
    deformation.cpu()
    gaussians, deformation, strays = _without_strays(fitted.to(torch.device("cpu")), deformation, len(video))
    if settings.fine_tune or strays:
        write_ply(job.outputs["gaussians"], gaussians)
    write_motion(job.outputs["motion"], deformation, kind, len(video), len(gaussians))
    curves.write(job.outputs["curves"], "motion fit", [step_prior.note])
    timestamps = torch.linspace(0, 1, min(PICTURE_FRAMES, len(video)))
    with torch.no_grad():
        states = deformation.displace(gaussians.means, timestamps).apply(gaussians)
    rows = [render_row(states, [azimuth] * len(timestamps), rasterize) for azimuth in (FRONT_DEG, SIDE_DEG)]
    write_png(job.outputs["picture"], torch.cat(rows))
    report = step_prior.report(f"{backend} rasterizer")
    told = ((tracked, TRACKED_NOTE), (strays, STRAYS.format(strays)), (settings.fine_tune, FINE_TUNED))
    return replace(report, notes=(*report.notes, *(note for happened, note in told if happened)))


def _without_strays(
    gaussians: Gaussians, deformation: AnyDeformation, frames: int
) -> tuple[Gaussians, AnyDeformation, int]:
    """Drop Gaussians that tear away from the subject; return the others, their deformation, and the number dropped."""
    times = torch.split(torch.linspace(0, 1, frames), STATES)
    with torch.no_grad():
        kept = ~find_strays(deformation.displace(gaussians.means, some).apply(gaussians) for some in times)
    if kept.all():
        return gaussians, deformation, 0
    return gaussians.subset(kept), deformation_of_subset(deformation, kept), int((~kept).sum())
