from dataclasses import replace
from itertools import accumulate
from statistics import median

import numpy as np
import pytest
import torch
import trimesh

from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.fitting.asset_motion import Report, iterations
from dg4d_lib.fitting.hinge import Cut
from dg4d_lib.fitting.hinge_tracking import Hinged
from dg4d_lib.fitting.rigid_parts import RigidMotion
from dg4d_lib.fitting.surface_tracking import track_surface, tracking_iterations
from dg4d_lib.fitting.tracking_order import is_loop, tracking_orders
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.guidance.moved import MovedSurfaces
from dg4d_lib.guidance.oracle import Bank
from dg4d_lib.inflation.render import render_surface
from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.kernels import workers
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.video.driving import DrivingVideo
from steps.fitting import tracking
from steps.fitting.tracking import BESIDE_FLOW, FLOW, HINGE, SOFT, SWING, SWINGS, SurfaceTracker, most_iterations

SIZE, FRAMES = 64, 3
WAYS = {
    "soft": SOFT,
    "loose": HINGE,
    "flow": FLOW,
    "bent": BESIDE_FLOW[0],
    "larger": BESIDE_FLOW[1],
    "swing": SWING,
    "stiffer": SWINGS[0],
    "stiffest": SWINGS[1],
}


def ball(x: float) -> InflatedSurface:
    mesh = trimesh.creation.icosphere(2, 0.3)
    vertices = torch.tensor(mesh.vertices, dtype=torch.float32) + torch.tensor([x, 0, 0])
    colors, seen = torch.full((len(vertices), 3), 0.5), torch.ones(len(vertices), dtype=torch.bool)
    return InflatedSurface(vertices, torch.tensor(mesh.faces), colors, seen)


def video_of(places: list[float]) -> DrivingVideo:
    camera = OrbitCamera(width=SIZE, height=SIZE)
    color, alpha = render_surface([ball(x) for x in places], [camera] * len(places))
    return DrivingVideo(color, alpha, 12)


def views(azimuths_deg: list[float]) -> Bank:
    cameras = tuple(OrbitCamera(0, azimuth, width=SIZE, height=SIZE) for azimuth in azimuths_deg)
    return Bank(cameras, (0,), torch.zeros(len(cameras), 1, SIZE, SIZE, 4, dtype=torch.uint8))


ALL_AROUND = list(range(0, 360, 20))


@pytest.mark.parametrize(
    ("azimuths_deg", "errors", "trackings", "kept"),
    [
        ([90, 180], {"soft": 0.0, "loose": 0.2}, 1, ["soft"]),  # the loose one serves the search of a hinge
        ([90, 180], {"soft": 0.0, "loose": 0.2, "swing": 0.1, "flow": 0.05}, 3, ["soft", "swing", "flow"]),
        ([90, 180], {"soft": 0.1, "swing": 0.1}, 1, ["swing"]),
        ([90], {"soft": 0.1, "swing": 0.1, "stiffer": 0.0, "stiffest": 0.02}, 3, ["swing", "stiffer", "stiffest"]),
        ([180], {"soft": 0.1, "swing": 0.11}, 1, ["swing"]),  # lost: a smaller overlap does not tell
        ([90, 180], {"soft": 0.1, "swing": 0.3}, 3, ["soft"]),  # far smaller
        (ALL_AROUND, {"flow": 0.0}, 1, ["flow"]),
        (ALL_AROUND, {"flow": 0.0, "bent": 0.1, "larger": 0.08, "soft": 0.05}, 3, ["flow", "bent", "larger", "soft"]),
        (ALL_AROUND, {"flow": 0.03, "swing": 0.0}, 1, ["swing"]),
        (ALL_AROUND, {"flow": 0.03, "swing": 0.03}, 1, ["flow"]),  # not lost, and no gain
        (
            ALL_AROUND,
            {"flow": 0.03, "swing": 0.03, "bent": 0.0, "larger": 0.0, "soft": 0.0},
            3,
            ["flow", "bent", "larger", "soft"],
        ),
        (
            ALL_AROUND,
            {"flow": 0.1, "swing": 0.11, "stiffer": 0.0, "stiffest": 0.02},
            3,
            ["swing", "stiffer", "stiffest"],
        ),
        (ALL_AROUND, {"flow": 0.1, "swing": 0.3}, 3, ["flow"]),  # lost in both
    ],
)
def test_how_a_surface_is_tracked_depends_on_how_it_keeps_the_outline(
    monkeypatch: pytest.MonkeyPatch,
    azimuths_deg: list[float],
    errors: dict[str, float],
    trackings: int,
    kept: list[str],
) -> None:
    done, told = list[str](), list[int]()

    def track(
        surface: InflatedSurface,
        gaussians: Gaussians,
        video: DrivingVideo,
        rasterize: object,
        settings: AssetSettings,
        generator: torch.Generator,
        report: Report,
    ) -> list[InflatedSurface]:
        name = next(name for name, one in WAYS.items() if settings == one)
        done.append(name)
        report(tracking_iterations(settings, video), {"loss": 1.0})
        shift = torch.tensor([errors[name], 0, 0])
        return [surface, *(replace(surface, vertices=surface.vertices + shift) for _ in range(FRAMES - 1))]

    monkeypatch.setattr(tracking, "track_surface", track)
    monkeypatch.setattr(tracking, "track_hinge", lambda *_: None)
    monkeypatch.setattr(workers, "thread_count", lambda: 1)  # one after the other
    video, known = video_of([0.0] * FRAMES), views(azimuths_deg)
    follow = tracker(video, known, trackings, lambda iteration, values: told.append(iteration))
    joined, median_of = list[float](), SurfaceTracker._median

    def record(self: SurfaceTracker, motions: list[MovedSurfaces]) -> MovedSurfaces:
        joined.extend(shift_of(one) for one in motions)
        return median_of(self, motions)

    monkeypatch.setattr(SurfaceTracker, "_median", record)
    moved = shift_of(follow(ball(0.0)))
    assert done == list(errors)
    assert (joined or [moved]) == pytest.approx([errors[name] for name in kept], abs=1e-5)
    assert moved == pytest.approx(median(errors[name] for name in kept), abs=1e-5)
    most = most_iterations(known, video, trackings)
    ends = accumulate(tracking_iterations(WAYS[name], video) for name in errors)
    assert told == [min(end, most) for end in ends]


def shift_of(moved: MovedSurfaces) -> float:
    """Return the mean place along x in the second frame."""
    return moved.surface(1).vertices[:, 0].mean().item()


def tracker(video: DrivingVideo, known: Bank, trackings: int, report: Report) -> SurfaceTracker:
    """Return a tracker of a cloud of one Gaussian."""
    points = torch.zeros(1, 3)
    cloud = Gaussians(points, points, torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1), torch.zeros(1, 1, 3))
    return SurfaceTracker(cloud, video, known, get_rasterizer("auto"), torch.Generator(), trackings, report)


@pytest.mark.parametrize(("shift", "asked"), [(0.0, True), (0.03, True), (0.2, False)])  # the last loses the outline
@pytest.mark.parametrize("azimuths_deg", [[90, 180], ALL_AROUND])
def test_a_hinge_that_is_found_replaces_all_other_trackings(
    monkeypatch: pytest.MonkeyPatch, shift: float, asked: bool, azimuths_deg: list[float]
) -> None:
    done, told = list[str](), list[int]()

    def follow(surface: InflatedSurface, *_: object) -> list[InflatedSurface]:
        done.append("free")
        moved = replace(surface, vertices=surface.vertices + torch.tensor([shift, 0, 0]))
        return [surface, *[moved] * (FRAMES - 1)]

    parts = RigidMotion(torch.tensor([0, 1]), torch.zeros(2, 3), torch.ones(FRAMES, 2, 4), torch.zeros(FRAMES, 2, 3))
    cut = Cut(np.array([0.0, 1.0, 0.0]), 0.1)

    def hinge(free: list[InflatedSurface], *others: object) -> Hinged:
        done.append("hinge")
        report = others[-1]
        assert callable(report)
        report(3, {"rigid parts": 1.0})
        return Hinged([free[0], *[ball(0.01)] * (FRAMES - 1)], parts, cut)

    monkeypatch.setattr(tracking, "track_surface", follow)
    monkeypatch.setattr(tracking, "track_hinge", hinge)
    video = video_of([0.0] * FRAMES)
    follower = tracker(video, views(azimuths_deg), 1, lambda iteration, values: told.append(iteration))
    tracked = follower(ball(0.0))
    assert (follower.hinged is not None) == asked
    assert ("hinge" in done) == asked
    assert told == ([3] if asked else [])
    if asked:
        assert done == ["free", "hinge"] if azimuths_deg is ALL_AROUND else ["free", "free", "hinge"]
        torch.testing.assert_close(tracked.surface(1).vertices, ball(0.01).vertices)


def test_trackings_tell_the_iterations_of_both_halves_of_a_loop() -> None:
    settings = SOFT.model_copy(update={"track_iterations": 2, "joint_iterations": 3, "size": 32, "nodes": 20})
    surface, video, told = ball(0.0), video_of([0.0, 0.02, 0.02, 0.0]), list[int]()
    points = surface.vertices[::4]
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(len(points), 1)
    harmonics = torch.zeros(len(points), 1, 3)
    cloud = Gaussians(points, torch.full_like(points, -3), quats, torch.full((len(points),), 4.0), harmonics)
    generator = torch.Generator().manual_seed(0)
    track_surface(
        surface,
        cloud,
        video,
        get_rasterizer("auto"),
        settings,
        generator,
        lambda iteration, values: told.append(iteration),
    )
    assert is_loop(video)
    halves = [iterations(settings, len(order)) for order in tracking_orders(video, 0)]
    skipped = settings.track_iterations  # the first frame of each half is at rest, and not tracked
    first = range(skipped + 1, halves[0] + 1)
    assert told == [*first, *range(halves[0] + skipped + 1, sum(halves) + 1)]
    assert told[-1] == tracking_iterations(settings, video)
