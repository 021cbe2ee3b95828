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


def sphere(radius: float = 0.4) -> tuple[torch.Tensor, torch.Tensor]:
    mesh = trimesh.creation.icosphere(4, radius)
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


def test_a_mesh_beside_its_cloud_is_drawn_onto_its_outline_in_every_frame() -> None:
    points = 0.36 * normalize(torch.randn(800, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    count = len(points)
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(2, count, 4)
    states = Gaussians(
        torch.stack([points, points + torch.tensor([0.1, 0.0, 0.0])]),
        torch.full((2, count, 3), -3.2),
        quats,
        torch.full((count,), 3.0),
        torch.zeros(count, 1, 3),
    )
    rasterize = get_rasterizer("cpu")
    alpha = rasterize(states, [CAMERA] * 2, torch.zeros(3)).alpha[..., 0]
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
