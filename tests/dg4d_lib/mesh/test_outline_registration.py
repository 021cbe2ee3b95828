"""Registration to outlines: normals, steps and answers that are known in closed form."""

import numpy as np
import pytest
import torch
import trimesh
from torch.nn.functional import normalize

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.extraction.silhouettes import render_silhouettes, silhouette_iou
from dg4d_lib.mesh.tracking.outline_registration import FACING, outline_of, outline_steps, register_to_outlines
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.settings import MeshSettings

CAMERA = OrbitCamera(width=256, height=256)


def sphere(radius: float = 0.4, subdivisions: int = 4) -> tuple[torch.Tensor, torch.Tensor]:
    mesh = trimesh.creation.icosphere(subdivisions, radius)
    return torch.from_numpy(mesh.vertices.astype(np.float32)), torch.from_numpy(mesh.faces.astype(np.int32))


def mask_of(vertices: torch.Tensor, faces: torch.Tensor, camera: OrbitCamera = CAMERA) -> np.ndarray:
    return (rasterize_mesh(vertices, faces, [camera]).faces[0] >= 0).numpy()


def test_outline_of_a_disc_lies_on_its_circle_and_points_outwards() -> None:
    rows, columns = np.mgrid[:100, :100] + 0.5
    outline = outline_of((rows - 50) ** 2 + (columns - 50) ** 2 < 30**2).points
    arms = outline[:, :2] - 50
    assert np.abs(np.linalg.norm(arms, axis=1) - 29.5).max() < 0.8  # centers of pixels inside a circle of 30
    cosines = (arms * outline[:, 2:]).sum(1) / np.linalg.norm(arms, axis=1) / FACING
    assert cosines.min() > 0.98


def test_outline_of_an_empty_mask_is_empty() -> None:
    assert len(outline_of(np.zeros((8, 8), bool)).points) == 0


@pytest.mark.parametrize("shift", [(0.02, 0.0), (0.0, -0.015)])
def test_a_shifted_outline_pulls_its_vertices_by_the_shift(shift: tuple[float, float]) -> None:
    vertices, faces = sphere()
    away = torch.tensor([*shift, 0.0])
    steps, share = outline_steps(vertices, faces, outline_of(mask_of(vertices + away, faces)).points, CAMERA)
    pulled = share > 0.5
    assert 20 < pulled.sum() < len(vertices) / 4  # those near the outline
    # nearest points see the shift along the normal alone, whose mean over a circle is half of it
    assert (steps[pulled].mean(0) / 0.5)[:2] == pytest.approx(shift, abs=0.006)
    assert np.abs(steps[:, 2]).max() < 1e-6  # parallel to the picture
    assert not steps[share == 0].any()


def ball_at(places: torch.Tensor) -> tuple[Gaussians, torch.Tensor]:
    """Return a ball of Gaussians at the places that it moves to, and its alpha at the input view."""
    points = 0.36 * normalize(torch.randn(800, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    frames, count = len(places), len(points)
    states = Gaussians(
        points + places[:, None],
        torch.full((frames, count, 3), -3.2),
        torch.tensor([[1.0, 0, 0, 0]]).expand(frames, count, 4),
        torch.full((count,), 3.0),
        torch.zeros(count, 1, 3),
    )
    return states, get_rasterizer("cpu")(states, [CAMERA] * frames, torch.zeros(3)).alpha[..., 0]


def test_a_mesh_beside_its_cloud_is_drawn_onto_its_outline_in_every_frame() -> None:
    states, alpha = ball_at(torch.tensor([[0.0, 0, 0], [0.1, 0, 0]]))
    rasterize = get_rasterizer("cpu")
    vertices, faces = sphere(0.37)
    offsets = torch.tensor([[0.03, 0.02, 0.0], [0.06, 0.0, 0.0]])[:, None].expand(2, len(vertices), 3).contiguous()
    settings = MeshSettings(grid=48)
    moved = register_to_outlines(vertices, offsets, faces, states, alpha, 0.5, rasterize, settings)
    silhouettes = render_silhouettes(states, [0, 1], rasterize, alpha)
    before = silhouette_iou(vertices + offsets, faces, silhouettes)
    after = silhouette_iou(vertices + moved, faces, silhouettes)
    assert before.max() < 0.93
    assert after.min() > 0.97
    again = register_to_outlines(vertices, offsets, faces, states, alpha, 0.5, rasterize, settings)
    assert torch.equal(moved, again)


def test_corrections_are_handed_on_from_frame_to_frame() -> None:
    """A ball that tracking loses is soon farther away than outlines reach from where tracking says it is."""
    frames = 9
    places = 0.05 * torch.arange(frames)[:, None] * torch.tensor([1.0, 0, 0])
    states, alpha = ball_at(places)
    vertices, faces = sphere(0.37, 3)
    lost, rasterize, settings = torch.zeros(frames, len(vertices), 3), get_rasterizer("cpu"), MeshSettings(grid=32)

    def errors(orders: list[list[int]]) -> torch.Tensor:
        found = register_to_outlines(
            vertices, lost, faces, states, alpha, 0.5, rasterize, settings, ((0, 6),), orders=orders
        )
        away: torch.Tensor = (found.mean(1) - places).norm(dim=-1)
        return away

    alone, together = errors([]), errors([list(range(frames)), [0]])
    assert alone[-1] > 0.3
    assert together[-1] < 0.7 * alone[-1]
    assert (together <= alone).all()


def test_halves_of_a_loop_go_on_into_each_other() -> None:
    """Tracking loses the end of one half, into which the other half follows the ball."""
    places = torch.tensor([0, 0.06, 0.12, 0.18, 0.24, 0.18, 0.12, 0.06])[:, None] * torch.tensor([1.0, 0, 0])
    states, alpha = ball_at(places)
    vertices, faces = sphere(0.37, 3)
    tracked = places[:, None].repeat(1, len(vertices), 1)
    tracked[5:7] = 0
    orders, settings, rasterize = [[0, 1, 2, 3, 4], [0, 7, 6, 5]], MeshSettings(grid=32), get_rasterizer("cpu")

    def errors(loop: bool) -> torch.Tensor:
        found = register_to_outlines(
            vertices, tracked, faces, states, alpha, 0.5, rasterize, settings, ((0, 3),), orders=orders, loop=loop
        )
        away: torch.Tensor = (found.mean(1) - places).norm(dim=-1)
        return away

    apart, together = errors(False), errors(True)
    assert together[5] < 0.5 * apart[5]
    known = [0, 1, 2, 3, 4, 7]
    assert torch.equal(together[known], apart[known])
