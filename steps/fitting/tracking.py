"""Shapes of later frames from the surface of known views, moved as the video shows it."""

import torch

from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.fitting.asset_motion import Report, iterations
from dg4d_lib.fitting.surface_tracking import DESCENT, LOST, swinging, swinging_is_better, track_surface
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.guidance.moved import MovedSurfaces
from dg4d_lib.guidance.oracle import Bank
from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.metrics.image import iou
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.settings import GeometricPriorSettings, LearnedPriorSettings, MotionSettings, PriorSettings
from dg4d_lib.video.driving import DrivingVideo
from dg4d_lib.visual_hull.shape import ALL_AROUND
from steps.fitting.priors import Track

TRACKED_NOTE = "motion of unseen sides: the surface of the known views, moved as the video shows it"
FLOW = AssetSettings(rigidity_loss="l1")  # for hulls of many views: both losses take twice the time and gain nothing
SOFT = DESCENT.model_copy(  # for hulls of few views, whose limbs may touch
    update={"across": AssetSettings().across, "whole_depth": 0.02}
)
SWING = swinging(SOFT)  # for what loses the outline
FOLLOWED = 0.93  # overlap of silhouettes with the video, IoU, below which flow is compared with a descent


def tracks_surface(settings: MotionSettings, prior: PriorSettings, known: Bank | None, frames: int) -> bool:
    """Return True if the surface of known views is tracked.

    Args:
        settings: of the motion fit, which ask for it.
        prior: must have shapes.
        known: must show the first frame alone.
        frames: of the video, two or more.
    """
    has_shapes = isinstance(prior, GeometricPriorSettings | LearnedPriorSettings)
    return settings.track_surface and has_shapes and known is not None and known.frames == (0,) and frames > 1


def tracking_of(known: Bank) -> AssetSettings:
    """Return how the surface of known views is tracked: where limbs are apart, by optical flow as a user's model is."""
    return FLOW if len(known.cameras) >= ALL_AROUND else SOFT


def tracking_iterations(known: Bank, frames: int) -> int:
    """Return the largest number of iterations that the tracker reports."""
    first = tracking_of(known)
    return iterations(first, frames) + (iterations(SWING, frames) if first is FLOW else 0)  # others are seldom lost


def surface_tracker(
    gaussians: Gaussians,
    video: DrivingVideo,
    known: Bank,
    rasterize: Rasterizer,
    generator: torch.Generator,
    report: Report = lambda iteration, values: None,
) -> Track:
    """Return what moves the surface of known views of the first frame; arguments as of `track_surface`.

    A surface that loses the outline, or that flow follows badly, is tracked a second time, with limbs that swing;
    `swinging_is_better` chooses between the two motions.
    """

    def follow(surface: InflatedSurface, settings: AssetSettings, told: Report) -> tuple[float, MovedSurfaces]:
        moved = MovedSurfaces(track_surface(surface, gaussians, video, rasterize, settings, generator, told))
        return _overlap(moved, video), moved

    def track(surface: InflatedSurface) -> MovedSurfaces:
        settings = tracking_of(known)
        overlap, moved = follow(surface, settings, report)
        if overlap >= (FOLLOWED if settings is FLOW else LOST):
            return moved
        done, most = iterations(settings, len(video)), tracking_iterations(known, len(video))
        second, other = follow(surface, SWING, lambda iteration, values: report(min(done + iteration, most), values))
        return other if swinging_is_better(overlap, second) else moved

    return track


def _overlap(moved: MovedSurfaces, video: DrivingVideo) -> float:
    """Return the intersection over union of silhouettes at the input view, mean over frames."""
    camera = OrbitCamera(width=video.alpha.shape[2], height=video.alpha.shape[1])
    _, alpha = moved.clean([GuidanceView(camera, frame) for frame in range(len(video))])
    return float(iou(alpha, video.alpha.to(alpha)).mean())
