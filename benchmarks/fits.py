"""Both fits of the pipeline on objects with ground truth, and the metrics of their results."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import benchmarks.measure  # noqa: F401 (before torch: how its threads wait)

import torch  # isort: skip

from benchmarks.objects.specimens import Specimen
from dg4d_lib.errors import BadInput
from dg4d_lib.fitting.motion import fit_motion
from dg4d_lib.fitting.static import fit_gaussians
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.guidance.distillation import TimestepSchedule
from dg4d_lib.guidance.interface import GuidancePrior
from dg4d_lib.guidance.oracle import Bank, perturb
from dg4d_lib.images import over_white
from dg4d_lib.inflation.hints import DepthHint
from dg4d_lib.metrics.image import iou, psnr
from dg4d_lib.metrics.video import temporal_error
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.settings import FitSettings, LgmStartSettings, OraclePriorSettings
from steps.artifacts.motions import new_deformation
from steps.fit_gaussians import initial_gaussians
from steps.fitting.priors import make_oracle_prior, make_prior, subject_shapes
from steps.profiles import PipelineSettings

RASTERIZE = get_rasterizer("auto")
BANK_SEED = 0  # seed of the errors of an imperfect oracle, as in `make_oracle_prior`


@dataclass(frozen=True)
class Figures:
    """Means over held-out views and frames; a static result has no `terr`."""

    psnr: float
    psnr_obj: float
    iou: float
    terr: float | None = None


def static_fit(specimen: Specimen, settings: PipelineSettings, seed: int) -> Gaussians:
    """Run the static stage on the first frame.

    Raises:
        BadInput: the prior's weights are damaged or of another model, or the fit should start with LGM.
        BackendUnavailable: the prior's weights are not installed.
    """
    return _fit_first_frame(_perturbed(specimen, settings), settings, seed)


def moving_fit(specimen: Specimen, rest: Gaussians, settings: PipelineSettings, seed: int) -> list[Gaussians]:
    """Run the dynamic stage; return the cloud at every frame, including frames that were not fitted."""
    generator = torch.Generator().manual_seed(seed)
    frames = len(specimen.cutouts)
    seen, stride = subsample_frames(_perturbed(specimen, settings), settings.subject.max_frames)
    deformation = new_deformation(settings.deformation, rest, len(seen.cutouts), generator)
    prior = prior_of(seen, settings, settings.motion)
    fitted = fit_motion(rest, deformation, seen.video, prior, RASTERIZE, settings.motion, generator)
    times = (torch.arange(frames) / (stride * (len(seen.cutouts) - 1))).clamp(max=1)
    with torch.no_grad():
        moved = deformation.displace(fitted.means, times).apply(fitted)
    return [moved.at(frame) for frame in range(frames)]


def fits_per_frame(
    specimen: Specimen, settings: PipelineSettings, seed: int, start: Gaussians | None = None
) -> list[Gaussians]:
    """Run the static stage on every frame separately, for as many iterations as the dynamic stage.

    Args:
        specimen: the object.
        settings: of the pipeline.
        seed: of every fit.
        start: initial Gaussians of every fit; None: by `static.start`. All their parameters are optimized.
    """
    static = settings.static.model_copy(update={"iterations": settings.motion.iterations})
    alone = settings.model_copy(update={"static": static})
    perturbed = _perturbed(specimen, settings)
    frames = range(len(specimen.cutouts))
    return [_fit_first_frame(_single_frame(perturbed, frame), alone, seed, start) for frame in frames]


def score(specimen: Specimen, states: Sequence[Gaussians]) -> Figures:
    """Compare the states of the first frames with the ground truth of the held-out cameras."""
    cutouts = specimen.views[:, : len(states)]
    with torch.no_grad():
        renders = [RASTERIZE(state, specimen.cameras, torch.ones(3)) for state in states]
    videos = torch.stack([render.color.clamp(0, 1) for render in renders], 1)
    alpha = torch.stack([render.alpha for render in renders], 1)
    rows = []
    for video, seen, cutout in zip(videos, alpha, cutouts, strict=True):
        wanted, mask = over_white(cutout), cutout[..., 3:]
        either = ((seen > 0.5) | (mask > 0.5)).float()
        rows.append([psnr(video, wanted).mean(), psnr(video, wanted, either).mean(), iou(seen, mask).mean()])
        if len(states) > 1:
            rows[-1].append(temporal_error(video, wanted))
    means = [float(sum(column) / len(rows)) for column in zip(*rows, strict=True)]
    return Figures(*means)


def prior_of(specimen: Specimen, settings: PipelineSettings, stage: FitSettings) -> GuidancePrior:
    """Return the guidance prior of a stage: the bank of the object as it is, or another prior of its cut-outs."""
    if not isinstance(settings.prior, OraclePriorSettings):
        return make_prior(settings.prior, list(specimen.cutouts), stage, None, Path(), _hint(settings)).prior
    noise = TimestepSchedule(
        stage.t_max_start, stage.t_max_end, stage.t_max_limit, uniform=stage.noise_draw == "uniform"
    )
    return make_oracle_prior(specimen.bank, OraclePriorSettings(), noise)


def subsample_frames(specimen: Specimen, most: int) -> tuple[Specimen, int]:
    """Return at most this many of the frames, and their stride."""
    stride = -(-len(specimen.cutouts) // most)
    kept = [column for column, frame in enumerate(specimen.bank.frames) if frame % stride == 0]
    frame_numbers = tuple(specimen.bank.frames[column] // stride for column in kept)
    bank = Bank(specimen.bank.cameras, frame_numbers, specimen.bank.pictures[:, kept])
    return replace(specimen, cutouts=specimen.cutouts[::stride], bank=bank, views=specimen.views[:, ::stride]), stride


def _fit_first_frame(
    specimen: Specimen, settings: PipelineSettings, seed: int, start: Gaussians | None = None
) -> Gaussians:
    """Fit Gaussians to the first frame, from `start` or by `static.start`; the bank has its errors already."""
    generator = torch.Generator().manual_seed(seed)
    first = replace(specimen, cutouts=specimen.cutouts[:1])
    prior = prior_of(first, settings, settings.static)
    if start is None:
        kind = settings.static.start
        if isinstance(kind, LgmStartSettings):
            raise BadInput("static.start.kind is lgm; these fits start with blob or surface")
        shapes = subject_shapes(settings.prior, list(first.cutouts), _hint(settings))
        start = initial_gaussians(kind, shapes, generator)
    return fit_gaussians(start, first.cutouts[0], prior, RASTERIZE, settings.static, generator)


def _hint(settings: PipelineSettings) -> DepthHint:
    return DepthHint(settings.subject.turn_deg or None)


def _perturbed(specimen: Specimen, settings: PipelineSettings) -> Specimen:
    """Return the specimen with the errors of an imperfect oracle in its bank.

    They are drawn for the whole bank, before frames are taken from it, so that all fits of an object see the same
    errors: a pose per view, blur, shift and gain per view and frame.
    """
    if not isinstance(settings.prior, OraclePriorSettings):
        return specimen
    return replace(specimen, bank=perturb(specimen.bank, settings.prior, torch.Generator().manual_seed(BANK_SEED)))


def _single_frame(specimen: Specimen, frame: int) -> Specimen:
    """Return a specimen of one frame, the nearest in the bank."""
    column = min(range(len(specimen.bank.frames)), key=lambda i: abs(specimen.bank.frames[i] - frame))
    bank = Bank(specimen.bank.cameras, (0,), specimen.bank.pictures[:, [column]])
    return replace(specimen, cutouts=specimen.cutouts[[frame]], bank=bank, views=specimen.views[:, [frame]])
