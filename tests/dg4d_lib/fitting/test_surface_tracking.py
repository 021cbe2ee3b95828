"""Tracking of a surface: a shift of the video shifts all of it, sides that nobody sees included."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "visual_hull"))
from creatures import creature, seen

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.fitting.surface_tracking import DESCENT, track_surface
from dg4d_lib.fitting.tracking_order import tracking_orders
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.guidance.known import KnownShapes
from dg4d_lib.guidance.moved import MovedSurfaces
from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.mesh.models.model import Model, ModelPart
from dg4d_lib.mesh.models.surface_cloud import cover_surface
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.video.driving import DrivingVideo

SETTINGS = DESCENT.model_copy(
    update={"fit_points": 600, "nodes": 16, "size": 48, "track_iterations": 25, "joint_iterations": 10}
)
SHIFT = 0.06


@pytest.fixture(scope="module")
def tracked() -> list[InflatedSurface]:
    """Return the creature tracked through a video in which it moves right."""
    generator = torch.Generator().manual_seed(0)
    part = ModelPart(
        "creature", creature().vertices.numpy(), creature().faces.numpy(), colors=creature().colors.numpy()
    )
    cloud = cover_surface(Model((part,)), 600, generator).cloud
    frames = torch.stack([seen(creature((SHIFT * frame, 0, 0)), 0, size=96).cutout for frame in range(3)])
    video = DrivingVideo(frames[..., :3].contiguous(), frames[..., 3:].contiguous(), 5.0)
    return track_surface(creature(), cloud, video, get_rasterizer("cpu"), SETTINGS, generator)


def test_all_of_the_surface_follows_the_video(tracked: list[InflatedSurface]) -> None:
    torch.testing.assert_close(tracked[0].vertices, creature().vertices)
    moved = tracked[2].vertices - tracked[0].vertices
    across, up, depth = moved.mean(0).tolist()
    assert (across, up) == pytest.approx((2 * SHIFT, 0), abs=0.015)
    assert abs(depth) < 0.05  # hardly visible: 0.05 changes the size by 2.5 %
    behind = tracked[0].vertices[:, 2] < -0.2
    assert float(moved[behind, 0].mean()) == pytest.approx(2 * SHIFT, abs=0.05)  # not seen: it may turn a little


def test_colors_and_faces_stay(tracked: list[InflatedSurface]) -> None:
    for surface in tracked:
        assert surface.faces is tracked[0].faces and surface.colors is tracked[0].colors


def test_views_of_a_moved_surface_show_it_at_their_frame(tracked: list[InflatedSurface]) -> None:
    surface = creature()
    shapes = MovedSurfaces([surface, replace(surface, vertices=surface.vertices + torch.tensor([0.2, 0, 0]))])
    camera = OrbitCamera(0, 180, width=48, height=48)
    _, alpha = shapes.clean([GuidanceView(camera, 1), GuidanceView(camera, 0)])
    columns = (alpha[..., 0].sum(1) * torch.arange(48)).sum(1) / alpha.sum((1, 2, 3))
    assert columns[0] < columns[1] - 3  # to the left, seen from behind
    with pytest.raises(BadInput, match="frame 2"):
        KnownShapes(shapes, {}).surface(2)


def test_loops_are_tracked_by_halves_and_other_videos_to_their_ends() -> None:
    turning = torch.zeros(6, 8, 8, 3)
    for frame in range(6):
        turning[frame, frame] = 1  # as far from the last frame to the first as between others
    alpha = torch.ones(6, 8, 8, 1)
    assert tracking_orders(DrivingVideo(turning, alpha, 5.0), 4) == ([4, 5, 0, 1], [4, 3, 2])
    growing = turning.cumsum(0)
    assert tracking_orders(DrivingVideo(growing, alpha, 5.0), 4) == ([4, 5], [4, 3, 2, 1, 0])
