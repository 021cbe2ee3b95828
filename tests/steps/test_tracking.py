from dataclasses import replace

import pytest
import torch
import trimesh

from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.fitting.asset_motion import Report, iterations
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.guidance.oracle import Bank
from dg4d_lib.inflation.render import render_surface
from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.video.driving import DrivingVideo
from steps.fitting import tracking
from steps.fitting.tracking import FLOW, SOFT, SWING, surface_tracker, tracking_iterations

SIZE, FRAMES = 64, 3
WAYS = {"soft": SOFT, "flow": FLOW, "swing": SWING}


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
    ("azimuths_deg", "first", "second", "tried", "kept"),
    [
        ([90, 180], 0.0, 0.0, ["soft"], "soft"),
        ([90, 180], 0.1, 0.1, ["soft", "swing"], "swing"),
        ([180], 0.1, 0.11, ["soft", "swing"], "swing"),  # lost: a smaller overlap does not tell
        ([90, 180], 0.1, 0.3, ["soft", "swing"], "soft"),  # far smaller
        (ALL_AROUND, 0.0, 0.0, ["flow"], "flow"),
        (ALL_AROUND, 0.03, 0.0, ["flow", "swing"], "swing"),
        (ALL_AROUND, 0.03, 0.03, ["flow", "swing"], "flow"),  # not lost, and no gain
        (ALL_AROUND, 0.1, 0.11, ["flow", "swing"], "swing"),
    ],
)
def test_a_surface_that_loses_the_outline_is_tracked_again(
    monkeypatch: pytest.MonkeyPatch, azimuths_deg: list[float], first: float, second: float, tried: list[str], kept: str
) -> None:
    errors, done = dict(zip(tried, (first, second), strict=False)), []
    told: list[int] = []

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
        report(7, {"loss": 1.0})
        shift = torch.tensor([errors[name], 0, 0])
        return [surface, *(replace(surface, vertices=surface.vertices + shift) for _ in range(FRAMES - 1))]

    monkeypatch.setattr(tracking, "track_surface", track)
    points = torch.zeros(1, 3)
    cloud = Gaussians(points, points, torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1), torch.zeros(1, 1, 3))
    follow = surface_tracker(
        cloud,
        video_of([0.0] * FRAMES),
        views(azimuths_deg),
        get_rasterizer("auto"),
        torch.Generator(),
        lambda iteration, values: told.append(iteration),
    )
    moved = follow(ball(0.0))
    assert done == tried
    second_ends = {"soft": iterations(SOFT, FRAMES), "flow": iterations(FLOW, FRAMES) + 7}  # soft has announced no more
    last = second_ends[tried[0]]
    assert told == [7, last][: len(tried)] and max(told) <= tracking_iterations(views(azimuths_deg), FRAMES)
    assert moved.surface(1).vertices[:, 0].mean().item() == pytest.approx(errors[kept], abs=1e-5)
