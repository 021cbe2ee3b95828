from collections.abc import Callable

import numpy as np
import pytest
import torch

from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.bake import bake, texels_of, vertex_normals
from dg4d_lib.mesh.unwrap import unwrap
from dg4d_lib.rasterizer.interface import choose_rasterizer
from dg4d_lib.settings import MeshSettings

SETTINGS = MeshSettings(texture_size=128, render_size=128)
RED, BLUE = torch.tensor([0.8, 0.1, 0.1]), torch.tensor([0.1, 0.1, 0.8])
Cloud = Callable[..., Gaussians]
Mesh = tuple[np.ndarray, np.ndarray]


def flattened(vertices: np.ndarray, faces: np.ndarray) -> tuple[torch.Tensor, ...]:
    """Vertices split at the seams, their normals, faces and uvs."""
    normals = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(faces))
    copied, corners, uvs = (torch.from_numpy(a) for a in unwrap(vertices, faces, SETTINGS.texture_size))
    return torch.from_numpy(vertices)[copied], normals[copied], corners, uvs


def red_and_blue(points: torch.Tensor) -> torch.Tensor:
    return torch.where(points[:, :1] > 0, RED, BLUE)


@pytest.fixture(scope="module")
def baked(sphere: Mesh, sphere_of_gaussians: Cloud) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """The texture of a red and blue sphere, its texels' places, and which half they are in."""
    # a second, smaller sphere inside that no view sees
    vertices = np.concatenate([sphere[0], 0.6 * sphere[0]])
    mesh = flattened(vertices, np.concatenate([sphere[1], sphere[1] + len(sphere[0])]))
    gaussians = sphere_of_gaussians(2500, 0.5, red_and_blue)
    texture = bake(*mesh, gaussians, choose_rasterizer("auto"), SETTINGS)
    texels = texels_of(*mesh, SETTINGS.texture_size)
    return texture[texels.rows, texels.columns], texels.positions, texture


def test_colors_of_both_halves_come_back(baked: tuple[torch.Tensor, ...]) -> None:
    colors, places, _ = baked
    outer = places.norm(dim=-1) > 0.45
    for half, color in ((places[:, 0] > 0.08, RED), (places[:, 0] < -0.08, BLUE)):
        assert (outer & half).sum() > 1500
        error = (colors[outer & half] - color).abs().amax(-1)
        assert error.max() < 0.05  # neither the white nor the black of a background, on no side


def test_what_no_view_sees_takes_the_color_of_what_lies_nearest(baked: tuple[torch.Tensor, ...]) -> None:
    colors, places, _ = baked
    inner = places.norm(dim=-1) < 0.35
    for half, color in ((places[:, 0] > 0.08, RED), (places[:, 0] < -0.08, BLUE)):
        assert (inner & half).sum() > 500
        assert (colors[inner & half] - color).abs().max() < 0.05


def test_texels_between_the_charts_repeat_what_lies_beside_them(baked: tuple[torch.Tensor, ...]) -> None:
    texture = baked[2].reshape(-1, 3)
    to_red, to_blue = (texture - RED).abs().amax(-1), (texture - BLUE).abs().amax(-1)
    assert (torch.minimum(to_red, to_blue) < 0.05).float().mean() > 0.85  # the rest is the border between the halves


def test_a_transparent_cloud_leaves_the_texture_gray(sphere: Mesh, sphere_of_gaussians: Cloud) -> None:
    gaussians = sphere_of_gaussians(50)
    faint = Gaussians(
        gaussians.means, gaussians.log_scales, gaussians.quats, gaussians.opacity_logits - 9, gaussians.harmonics
    )
    texture = bake(*flattened(*sphere), faint, choose_rasterizer("auto"), SETTINGS)
    assert (texture == 0.5).all()


def test_texel_centers_lie_half_a_texel_inside() -> None:
    square = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(4, 3)
    texels = texels_of(square, up, torch.tensor([[0, 1, 2], [0, 2, 3]]), square[:, :2], 4)
    assert len(texels.rows) == 16
    expected = (torch.stack([texels.columns, texels.rows], -1) + 0.5) / 4
    torch.testing.assert_close(texels.positions[:, :2], expected)


def test_normals_of_a_sphere_point_outwards(sphere: Mesh) -> None:
    vertices, faces = (torch.from_numpy(part) for part in sphere)
    outwards = torch.nn.functional.normalize(vertices, dim=-1)
    assert ((vertex_normals(vertices, faces) * outwards).sum(-1) > 0.97).all()
