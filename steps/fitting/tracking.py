"""Shapes of later frames from the surface of known views, moved as the video shows it."""

import threading
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import count

import torch

from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.fitting.asset_motion import Report
from dg4d_lib.fitting.hinge_tracking import HINGE_ITERATIONS, Hinged, track_hinge
from dg4d_lib.fitting.surface_tracking import (
    DESCENT,
    LOST,
    swinging,
    swinging_is_better,
    track_surface,
    tracking_iterations,
)
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.guidance.moved import MovedSurfaces
from dg4d_lib.guidance.oracle import Bank
from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.kernels.workers import run_parallel, torch_on_one_thread
from dg4d_lib.metrics.image import iou
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.settings import GeometricPriorSettings, LearnedPriorSettings, MotionSettings, PriorSettings
from dg4d_lib.video.driving import DrivingVideo
from dg4d_lib.visual_hull.shape import ALL_AROUND

TRACKED_NOTE = "motion of unseen sides: the surface of the known views, tracked through the video"
FLOW = AssetSettings(rigidity_loss="l1", rigid_parts=0)  # for hulls of many views
HINGE = DESCENT.model_copy(update={"across": AssetSettings().across, "whole_depth": 0.02})  # for lids
SOFT = HINGE.model_copy(update={"size": 192, "rigidity": 0.6})  # for hulls of few views, whose limbs may touch
SWING = swinging(SOFT).model_copy(update={"rigidity": 1.0})  # for what loses the outline
BESIDE_SOFT = (SWING, FLOW)  # for what keeps it
BENT = tuple(FLOW.model_copy(update={"rigidity_loss": "log", "size": size}) for size in (112, 144))
BESIDE_FLOW = (*BENT, SOFT)  # likewise
SWINGS = tuple(SWING.model_copy(update={"rigidity": rigidity}) for rigidity in (2.0, 4.0))  # beside SWING
HINGE_SEED = 0  # of the tracking for the search of a hinge; its own, so that all other random numbers stay the same
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
    """Return the tracking settings for the surface of known views: optical flow if the views surround it."""
    return FLOW if len(known.cameras) >= ALL_AROUND else SOFT


def most_iterations(known: Bank, video: DrivingVideo, trackings: int) -> int:
    """Return the largest number of iterations that a `SurfaceTracker` reports."""
    first = tracking_of(known)
    second = (SWING,) if first is FLOW else (HINGE,)  # hulls of few pictures are seldom lost
    more = (*second, *_others(first)) if trackings > 1 else second
    return sum(tracking_iterations(settings, video) for settings in (first, *more)) + HINGE_ITERATIONS


def _others(first: AssetSettings) -> tuple[AssetSettings, ...]:
    """Return the other ways of tracking a surface that keeps the outline."""
    return BESIDE_FLOW if first is FLOW else BESIDE_SOFT


class SurfaceTracker:
    """Moves the surface of known views of the first frame as the video shows it.

    If the motion is that of a lid or a door on a hinge, the fit of the hinge is the answer; hulls of few pictures are
    tracked with little rigidity for its search, as a stiff lid does not tear off. Else a surface that loses
    the outline, or that flow follows badly, is tracked a second time, with limbs that swing; `swinging_is_better`
    chooses between the two motions. Surfaces are then tracked in two or three more ways, whose errors at unseen sides
    differ, and every vertex takes the median of its places. The ways are two stiffer ones where limbs swing; else
    hulls of few pictures by flow and with limbs that swing, those of many by flow with few joints that bend a lot, in
    two sizes of the pictures, and by descent.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        video: DrivingVideo,
        known: Bank,
        rasterize: Rasterizer,
        generator: torch.Generator,
        trackings: int,
        report: Report = lambda iteration, values: None,
    ) -> None:
        """Store what all trackings share; other arguments as of `track_surface`.

        Args:
            known: views of the first frame.
            trackings: 1, or 3 for all ways.
        """
        self._gaussians, self._video, self._rasterize, self._generator = gaussians, video, rasterize, generator
        self._first = tracking_of(known)
        self._several = trackings > 1
        self._most, self._report = most_iterations(known, video, trackings), report
        self._numbers, self._done = count(), [0] * (3 + len(BESIDE_FLOW))  # iterations of every tracking
        self._here = threading.get_ident()  # callbacks of a job belong to its thread
        self.hinged: Hinged | None = None  # what a call found

    def __call__(self, surface: InflatedSurface) -> MovedSurfaces:
        """Return the surface at all frames.

        Raises:
            FitDiverged: a loss became non-finite.
        """
        with torch_on_one_thread():
            ways: Sequence[AssetSettings] = _others(self._first)
            moved = self._follow(surface, self._first, self._generator)
            overlap = self._overlap(moved)
            self.hinged = self._on_a_hinge(self._motion_for_hinges(moved)) if overlap >= LOST else None
            if self.hinged:
                return MovedSurfaces(self.hinged.surfaces)
            if overlap < (FOLLOWED if self._first is FLOW else LOST):
                second = self._follow(surface, SWING, self._generator)
                if swinging_is_better(overlap, self._overlap(second)):
                    moved, ways = second, SWINGS
                elif overlap < LOST:
                    return moved
            return self._median([moved, *self._followed_in(ways, surface)]) if self._several else moved

    def _median(self, motions: Sequence[MovedSurfaces]) -> MovedSurfaces:
        """Return the surface whose coordinates are the medians over several motions, frame by frame."""
        frames = []
        for frame in range(len(self._video)):
            surfaces = [moved.surface(frame) for moved in motions]
            places = torch.stack([one.vertices for one in surfaces]).sort(0).values
            middle = (places[(len(places) - 1) // 2] + places[len(places) // 2]) / 2
            frames.append(replace(surfaces[0], vertices=middle))
        return MovedSurfaces(frames)

    def _followed_in(self, ways: Sequence[AssetSettings], surface: InflatedSurface) -> list[MovedSurfaces]:
        seeds = torch.randint(2**62, (len(ways),), generator=self._generator).tolist()
        found: dict[int, MovedSurfaces] = {}

        def follow(way: int) -> None:
            found[way] = self._follow(surface, ways[way], torch.Generator().manual_seed(seeds[way]))

        run_parallel([partial(follow, way) for way in range(len(ways))])
        return [found[way] for way in range(len(ways))]

    def _follow(self, surface: InflatedSurface, settings: AssetSettings, generator: torch.Generator) -> MovedSurfaces:
        return MovedSurfaces(
            track_surface(
                surface, self._gaussians, self._video, self._rasterize, settings, generator, self._next_report()
            )
        )

    def _motion_for_hinges(self, moved: MovedSurfaces) -> MovedSurfaces:
        """Return the motion in which a hinge is searched: the first one by flow, else one with little rigidity."""
        if self._first is FLOW:
            return moved
        return self._follow(moved.surface(0), HINGE, torch.Generator().manual_seed(HINGE_SEED))

    def _on_a_hinge(self, free: MovedSurfaces) -> Hinged | None:
        surfaces = [free.surface(frame) for frame in range(len(self._video))]
        return track_hinge(surfaces, self._gaussians, self._video, self._rasterize, HINGE, self._next_report())

    def _next_report(self) -> Report:
        """Return what one more fit reports its iterations to."""
        number = next(self._numbers)

        def on_progress(iteration: int, values: dict[str, float]) -> None:
            self._done[number] = iteration
            if threading.get_ident() == self._here:
                self._report(min(sum(self._done), self._most), values)

        return on_progress

    def _overlap(self, moved: MovedSurfaces) -> float:
        """Return the intersection over union of silhouettes at the input view, mean over frames."""
        alpha = self._video.alpha
        camera = OrbitCamera(width=alpha.shape[2], height=alpha.shape[1])
        _, drawn = moved.clean([GuidanceView(camera, frame) for frame in range(len(self._video))])
        return float(iou(drawn, alpha.to(drawn)).mean())
