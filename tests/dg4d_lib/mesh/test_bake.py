from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy import ndimage
from torch.nn.functional import max_pool2d

from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.normals import vertex_normals
from dg4d_lib.mesh.texturing.bake import PosedSurface, bake_texture, gaussian_renderer, locate_texels
from dg4d_lib.mesh.texturing.unwrap import unwrap
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.settings import MeshSettings

SETTINGS = MeshSettings(texture_size=128, render_size=128)
RED, GREEN, BLUE = torch.tensor([0.8, 0.1, 0.1]), torch.tensor([0.1, 0.8, 0.1]), torch.tensor([0.1, 0.1, 0.8])
Cloud = Callable[..., Gaussians]
Mesh = tuple[np.ndarray, np.ndarray]


def flattened(vertices: np.ndarray, faces: np.ndarray) -> tuple[torch.Tensor, ...]:
    """Vertices split at the seams, their normals, faces and uvs."""
    normals = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(faces))
    copied, corners, uvs = (torch.from_numpy(a) for a in unwrap(vertices, faces, SETTINGS.texture_size))
    return torch.from_numpy(vertices)[copied], normals[copied], corners, uvs


def green_frame(alpha: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Color and alpha of a frame."""
    side = SETTINGS.render_size
    return GREEN.expand(side, side, 3), torch.full((side, side, 1), alpha)


def red_and_blue(points: torch.Tensor) -> torch.Tensor:
    return torch.where(points[:, :1] > 0, RED, BLUE)


@pytest.fixture(scope="module")
def baked(sphere: Mesh, sphere_of_gaussians: Cloud) -> tuple[torch.Tensor, ...]:
    """The colors of a red and blue sphere's texels, their places; the texture, and where they lie in it."""
    # a second, smaller sphere inside that no view sees
    vertices = np.concatenate([sphere[0], 0.6 * sphere[0]])
    mesh = flattened(vertices, np.concatenate([sphere[1], sphere[1] + len(sphere[0])]))
    gaussians = sphere_of_gaussians(2500, 0.5, red_and_blue)
    texture = bake_texture(*mesh, gaussian_renderer(gaussians, get_rasterizer("auto")), SETTINGS)
    texels = locate_texels(*mesh, SETTINGS.texture_size)
    where = torch.stack([texels.rows, texels.columns])
    return texture[texels.rows, texels.columns], texels.positions, texture, where


def test_colors_of_both_halves_come_back(baked: tuple[torch.Tensor, ...]) -> None:
    colors, places = baked[:2]
    outer = places.norm(dim=-1) > 0.45
    for half, color in ((places[:, 0] > 0.08, RED), (places[:, 0] < -0.08, BLUE)):
        assert (outer & half).sum() > 1500
        error = (colors[outer & half] - color).abs().amax(-1)
        assert error.max() < 0.05  # neither the white nor the black of a background, on no side


def test_what_no_view_sees_takes_the_color_of_what_lies_nearest(baked: tuple[torch.Tensor, ...]) -> None:
    colors, places = baked[:2]
    inner = places.norm(dim=-1) < 0.35
    for half, color in ((places[:, 0] > 0.08, RED), (places[:, 0] < -0.08, BLUE)):
        assert (inner & half).sum() > 500
        assert (colors[inner & half] - color).abs().max() < 0.05


def test_every_texel_in_a_gutter_has_a_color_of_the_chart_beside_it(baked: tuple[torch.Tensor, ...]) -> None:
    """Within two texels of a chart: what bilinear reading along a seam can reach.

    Leveled seams extrapolate a little where the colors have an edge.
    """
    colors, _, texture, texels = baked
    inside = torch.zeros(texture.shape[:2], dtype=torch.bool)
    inside[texels[0], texels[1]] = True
    assert torch.equal(texture[texels[0], texels[1]], colors)

    def highest(values: torch.Tensor) -> torch.Tensor:
        seen = torch.where(inside[..., None], values, -1.0).movedim(-1, 0)
        return max_pool2d(seen, 5, 1, 2).movedim(0, -1)

    beside = ndimage.distance_transform_edt(~inside.numpy()) <= 2
    gutter = torch.from_numpy(beside) & ~inside
    assert gutter.sum() > 1000
    assert (texture <= highest(texture) + 0.2)[gutter].all()
    assert (texture >= -highest(-texture) - 0.2)[gutter].all()


def test_far_from_all_charts_there_is_no_hole_either(baked: tuple[torch.Tensor, ...]) -> None:
    """Everything is a blend of red and blue."""
    share = (baked[2][..., 0] - BLUE[0]) / (RED[0] - BLUE[0])
    blend = torch.lerp(BLUE, RED, share[..., None])
    assert (baked[2] - blend).abs().max() < 0.06
    assert -0.1 < share.min() < share.max() < 1.1


def test_footage_colors_what_it_shows_where_the_surface_was(sphere: Mesh, sphere_of_gaussians: Cloud) -> None:
    """Green frames of a sphere of red and blue Gaussians that turned by a right angle about y.

    What faced the camera in the frame becomes green; what faced it at rest is oblique there and keeps its color.
    """
    vertices, normals, faces, uvs = flattened(*sphere)
    turned = torch.tensor([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # takes x to z
    footage = PosedSurface(vertices @ turned, normals @ turned, *green_frame(1.0))
    gaussians = sphere_of_gaussians(2500, 0.5, red_and_blue)
    texture = bake_texture(
        vertices, normals, faces, uvs, gaussian_renderer(gaussians, get_rasterizer("auto")), SETTINGS, [footage]
    )
    texels = locate_texels(vertices, normals, faces, uvs, SETTINGS.texture_size)
    colors = texture[texels.rows, texels.columns]
    shown, hidden = texels.normals @ turned[:, 2] > 0.85, texels.normals @ turned[:, 2] < -0.2
    assert shown.sum() > 300 and hidden.sum() > 1000
    assert (colors[shown] - GREEN).abs().max() < 0.05
    assert (colors[hidden, 1] < 0.2).all()


def test_footage_is_averaged_by_weight(sphere: Mesh, sphere_of_gaussians: Cloud) -> None:
    """Three parts of green and one part of black, with next to nothing of the Gaussians, where the frames look."""
    mesh = flattened(*sphere)
    green, alpha = green_frame(1.0)
    footage = [PosedSurface(*mesh[:2], green, alpha, 3.0), PosedSurface(*mesh[:2], torch.zeros_like(green), alpha)]
    texture = bake_texture(
        *mesh, gaussian_renderer(sphere_of_gaussians(600), get_rasterizer("auto")), SETTINGS, footage
    )
    texels = locate_texels(*mesh, SETTINGS.texture_size)
    shown = texels.normals[:, 2] > 0.85
    assert shown.sum() > 300
    assert (texture[texels.rows, texels.columns][shown] - 0.75 * GREEN).abs().max() < 0.05


def test_footage_fades_out_within_a_pixel_of_its_outline(sphere: Mesh, sphere_of_gaussians: Cloud) -> None:
    """A green frame that ends in the middle of the sphere, and a black one; a pixel is six texels wide."""
    side, settings = 24, MeshSettings(texture_size=256, render_size=128)
    vertices, normals, corners, uvs = flattened(*sphere)
    left = (torch.arange(side) <= side // 2)[None, :, None].expand(side, side, 1).float()
    whole, green = torch.ones(side, side, 1), GREEN.expand(side, side, 3)
    footage = [
        PosedSurface(vertices, normals, green, left),
        PosedSurface(vertices, normals, torch.zeros_like(green), whole),
    ]
    draw = gaussian_renderer(sphere_of_gaussians(600), get_rasterizer("auto"))
    texture = bake_texture(vertices, normals, corners, uvs, draw, settings, footage)
    texels = locate_texels(vertices, normals, corners, uvs, settings.texture_size)
    shown = torch.zeros(texture.shape[:2], dtype=torch.bool)
    shown[texels.rows, texels.columns] = texels.normals[:, 2] > 0.85
    jumps = [
        texture[..., 1].diff(dim=axis).abs()[shown.narrow(axis, 1, 255) & shown.narrow(axis, 0, 255)] for axis in (0, 1)
    ]
    assert texture[shown][:, 1].max() > 0.35 and texture[shown][:, 1].min() < 0.05
    assert max(float(jump.max()) for jump in jumps) < 0.2


def test_transparent_footage_changes_nothing(sphere: Mesh, sphere_of_gaussians: Cloud) -> None:
    mesh, gaussians = flattened(*sphere), sphere_of_gaussians(600, 0.5, red_and_blue)
    nothing = PosedSurface(*mesh[:2], *green_frame(0.0))
    draw = gaussian_renderer(gaussians, get_rasterizer("auto"))
    textures = [bake_texture(*mesh, draw, SETTINGS, given) for given in ((), [nothing])]
    assert (textures[0] - textures[1]).abs().mean() < 0.01  # the front then comes from oblique views


def test_a_transparent_cloud_leaves_the_texture_gray(sphere: Mesh, sphere_of_gaussians: Cloud) -> None:
    gaussians = sphere_of_gaussians(50)
    faint = Gaussians(
        gaussians.means, gaussians.log_scales, gaussians.quats, gaussians.opacity_logits - 9, gaussians.harmonics
    )
    texture = bake_texture(*flattened(*sphere), gaussian_renderer(faint, get_rasterizer("auto")), SETTINGS)
    assert (texture == 0.5).all()


def test_texel_centers_lie_half_a_texel_inside() -> None:
    square = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(4, 3)
    texels = locate_texels(square, up, torch.tensor([[0, 1, 2], [0, 2, 3]]), square[:, :2], 4)
    assert len(texels.rows) == 16
    expected = (torch.stack([texels.columns, texels.rows], -1) + 0.5) / 4
    torch.testing.assert_close(texels.positions[:, :2], expected)


def test_normals_of_a_sphere_point_outwards(sphere: Mesh) -> None:
    vertices, faces = (torch.from_numpy(part) for part in sphere)
    outwards = torch.nn.functional.normalize(vertices, dim=-1)
    assert ((vertex_normals(vertices, faces) * outwards).sum(-1) > 0.97).all()
