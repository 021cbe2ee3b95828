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
from steps.fitting.tracking import FLOW, SOFT, surface_tracker, tracking_iterations

SIZE, FRAMES = 64, 3


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


@pytest.mark.parametrize(
    ("azimuths_deg", "soft", "flow", "tried", "kept"),
    [
        ([90, 180], 0.0, 0.1, ["soft"], "soft"),  # follows well: flow has no try
        ([90, 180], 0.4, 0.1, ["soft", "flow"], "flow"),
        ([90, 180], 0.3, 0.4, ["soft", "flow"], "soft"),
        ([180], 0.4, 0.1, ["soft"], "soft"),  # the depth is a guess
        (list(range(0, 360, 20)), 0.4, 0.0, ["flow"], "flow"),  # follows well: descent has no try
        (list(range(0, 360, 20)), 0.4, 0.1, ["flow", "soft"], "flow"),
        (list(range(0, 360, 20)), 0.0, 0.1, ["flow", "soft"], "soft"),
    ],
)
def test_of_flow_and_descent_the_one_that_keeps_the_outline_wins(
    monkeypatch: pytest.MonkeyPatch, azimuths_deg: list[float], soft: float, flow: float, tried: list[str], kept: str
) -> None:
    errors, done = {"soft": soft, "flow": flow}, []
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
        name = {"descent": "soft", "flow": "flow"}[settings.tracking]
        assert settings == {"soft": SOFT, "flow": FLOW}[name]
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
    last = {"soft": iterations(SOFT, FRAMES), "flow": iterations(FLOW, FRAMES) + 7}[tried[0]]
    assert told == [7, last][: len(tried)] and max(told) <= tracking_iterations(views(azimuths_deg), FRAMES)
    assert moved.surface(1).vertices[:, 0].mean().item() == pytest.approx(errors[kept], abs=1e-5)
