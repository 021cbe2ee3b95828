"""Both fits of the pipeline on objects with ground truth, and the metrics of their results."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import benchmarks.measure  # noqa: F401 (before torch: how its threads wait)

import torch  # isort: skip

from benchmarks.objects.specimens import Specimen
from dg4d_lib.fitting.motion import fit_motion
from dg4d_lib.fitting.static import fit_gaussians
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.guidance.analytic import AnalyticPrior
from dg4d_lib.guidance.distillation import TimestepSchedule
from dg4d_lib.guidance.oracle import Bank
from dg4d_lib.images import over_white
from dg4d_lib.inflation.hints import DepthHint
from dg4d_lib.metrics.image import iou, psnr
from dg4d_lib.metrics.video import temporal_error
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.settings import FitSettings, LgmStartSettings, OraclePriorSettings
from steps.artifacts.motions import new_deformation
from steps.fit_gaussians import initial_gaussians
from steps.fitting.priors import make_oracle_prior, subject_shapes
from steps.profiles import PipelineSettings

RASTERIZE = get_rasterizer("auto")


@dataclass(frozen=True)
class Figures:
    """Means over held-out views and frames; a static result has no `terr`."""

    psnr: float
    psnr_obj: float
    iou: float
    terr: float | None = None


def static_fit(specimen: Specimen, settings: PipelineSettings, seed: int) -> Gaussians:
    """Run the static stage on the first frame."""
    generator = torch.Generator().manual_seed(seed)
    subject = specimen.cutouts[0]
    kind = settings.static.start
    assert not isinstance(kind, LgmStartSettings), "these fits start without LGM"
    start = initial_gaussians(
        kind, subject_shapes(settings.prior, [subject], DepthHint(settings.subject.turn_deg or None)), generator
    )
    prior = prior_of(specimen.bank, settings, settings.static)
    return fit_gaussians(start, subject, prior, RASTERIZE, settings.static, generator)


def moving_fit(specimen: Specimen, rest: Gaussians, settings: PipelineSettings, seed: int) -> list[Gaussians]:
    """Run the dynamic stage; return the cloud at every frame, including frames that were not fitted."""
    generator = torch.Generator().manual_seed(seed)
    frames = len(specimen.cutouts)
    seen, stride = subsample_frames(specimen, settings.subject.max_frames)
    deformation = new_deformation(settings.deformation, rest, len(seen.cutouts), generator)
    prior = prior_of(seen.bank, settings, settings.motion)
    fitted = fit_motion(rest, deformation, seen.video, prior, RASTERIZE, settings.motion, generator)
    times = (torch.arange(frames) / (stride * (len(seen.cutouts) - 1))).clamp(max=1)
    with torch.no_grad():
        moved = deformation.displace(fitted.means, times).apply(fitted)
    return [moved.at(frame) for frame in range(frames)]


def fits_per_frame(specimen: Specimen, settings: PipelineSettings, seed: int) -> list[Gaussians]:
    """Run the static stage on every frame separately, for as many iterations as the dynamic stage."""
    static = settings.static.model_copy(update={"iterations": settings.motion.iterations})
    alone = settings.model_copy(update={"static": static})
    return [static_fit(_moment(specimen, frame), alone, seed) for frame in range(len(specimen.cutouts))]


def score(specimen: Specimen, states: Sequence[Gaussians]) -> Figures:
    """Compare the states of the first frames with the ground truth of the held-out cameras."""
    cutouts = specimen.views[:, : len(states)]
    with torch.no_grad():
        drawn = [RASTERIZE(state, specimen.cameras, torch.ones(3)) for state in states]
    films = torch.stack([picture.color.clamp(0, 1) for picture in drawn], 1)
    alpha = torch.stack([picture.alpha for picture in drawn], 1)
    rows = []
    for film, seen, cutout in zip(films, alpha, cutouts, strict=True):
        wanted, mask = over_white(cutout), cutout[..., 3:]
        either = ((seen > 0.5) | (mask > 0.5)).float()
        rows.append([psnr(film, wanted).mean(), psnr(film, wanted, either).mean(), iou(seen, mask).mean()])
        if len(states) > 1:
            rows[-1].append(temporal_error(film, wanted))
    means = [float(sum(column) / len(rows)) for column in zip(*rows, strict=True)]
    return Figures(*means)


def prior_of(bank: Bank, settings: PipelineSettings, stage: FitSettings) -> AnalyticPrior:
    """Return the oracle, perturbed or not, with the timestep schedule of a stage."""
    assert isinstance(settings.prior, OraclePriorSettings), "these fits are made with prior.kind = oracle"
    noise = TimestepSchedule(
        stage.t_max_start, stage.t_max_end, stage.t_max_limit, uniform=stage.noise_draw == "uniform"
    )
    return make_oracle_prior(bank, settings.prior, noise)


def subsample_frames(specimen: Specimen, most: int) -> tuple[Specimen, int]:
    """Return at most this many of the frames, and their stride."""
    stride = -(-len(specimen.cutouts) // most)
    kept = [column for column, frame in enumerate(specimen.bank.frames) if frame % stride == 0]
    moments = tuple(specimen.bank.frames[column] // stride for column in kept)
    bank = Bank(specimen.bank.cameras, moments, specimen.bank.pictures[:, kept])
    return replace(specimen, cutouts=specimen.cutouts[::stride], bank=bank, views=specimen.views[:, ::stride]), stride


def _moment(specimen: Specimen, frame: int) -> Specimen:
    """Return a specimen of one frame, the nearest in the bank."""
    column = min(range(len(specimen.bank.frames)), key=lambda i: abs(specimen.bank.frames[i] - frame))
    bank = Bank(specimen.bank.cameras, (0,), specimen.bank.pictures[:, [column]])
    return replace(specimen, cutouts=specimen.cutouts[[frame]], bank=bank, views=specimen.views[:, [frame]])
