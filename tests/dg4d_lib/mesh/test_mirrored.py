"""Colors of the far side, taken from the near side across the mirror plane."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.geometry.normals import vertex_normals
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh.texturing.bake import PosedSurface, Texels, locate_texels
from dg4d_lib.mesh.texturing.mirrored import mirror_texture
from dg4d_lib.mesh.texturing.unwrap import unwrap
from dg4d_lib.shape_prior.mirror import MirrorPlane

SIZE = 256
GRAY = 0.5
ACROSS_DEPTH = MirrorPlane(torch.tensor([0.0, 0, 1]), torch.zeros(3), 1.0)
Ball = tuple[TexturedMesh, torch.Tensor, Texels]


def stripes(places: torch.Tensor) -> torch.Tensor:
    """Return colors of a pattern that is not symmetric in x and y."""
    x, y = places[:, 0], places[:, 1]
    return torch.stack([0.5 + 0.4 * torch.sin(12 * x + 4 * y), 0.5 + 0.3 * y, 0.5 - 0.5 * x], -1)


@pytest.fixture
def ball(sphere: tuple[np.ndarray, np.ndarray]) -> Ball:
    """A ball with a pattern in front and gray behind, its normals and its texels."""
    vertices, faces = map(torch.from_numpy, sphere)
    sources, corners, uvs = map(torch.from_numpy, unwrap(*sphere, SIZE))
    normals = vertex_normals(vertices, faces)[sources]
    texels = locate_texels(vertices[sources], normals, corners, uvs, SIZE)
    front = texels.positions[:, 2:] > 0
    texture = torch.full((SIZE, SIZE, 3), GRAY)
    texture[texels.rows, texels.columns] = torch.where(front, stripes(texels.positions), GRAY)
    return TexturedMesh(vertices[sources], corners, uvs, texture), normals, texels


def shown(mesh: TexturedMesh, normals: torch.Tensor, turn_deg: float = 0.0) -> PosedSurface:
    """Return the ball in a frame that it fills, turned about y."""
    angle = torch.deg2rad(torch.tensor(turn_deg))
    sine, cosine = angle.sin(), angle.cos()
    turn = torch.tensor([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])
    frame = torch.ones(128, 128, 3), torch.ones(128, 128, 1)
    return PosedSurface(mesh.vertices @ turn, normals @ turn, *frame)


def test_the_far_side_has_the_pattern_of_the_near_one(ball: Ball) -> None:
    mesh, normals, texels = ball
    texture, share = mirror_texture(mesh, [shown(mesh, normals)], ACROSS_DEPTH)
    before, after = (one[texels.rows, texels.columns] for one in (mesh.texture, texture))
    direct = texels.positions[:, 2] / texels.positions.norm(dim=1)
    back, front = direct < -0.6, direct > 0.5
    assert back.sum() > 1000
    assert (after[back] - stripes(texels.positions[back])).abs().mean() < 0.02
    assert (after[front] - before[front]).abs().mean() < 0.002
    assert 0.15 < share < 0.5


def test_a_plane_that_is_trusted_in_part_mixes_the_colors(ball: Ball) -> None:
    mesh, normals, texels = ball
    plane = replace(ACROSS_DEPTH, trust=0.5)
    texture, share = mirror_texture(mesh, [shown(mesh, normals)], plane)
    back = texels.positions[:, 2] / texels.positions.norm(dim=1) < -0.7
    after = texture[texels.rows, texels.columns][back]
    assert (after - (GRAY + stripes(texels.positions[back])) / 2).abs().mean() < 0.02
    assert share == 0


def test_what_another_frame_shows_keeps_its_color(ball: Ball) -> None:
    mesh, normals, texels = ball
    turned = shown(mesh, normals, 180.0)
    texture, _ = mirror_texture(mesh, [shown(mesh, normals), turned], ACROSS_DEPTH)
    back = texels.positions[:, 2] / texels.positions.norm(dim=1) < -0.7
    assert (texture[texels.rows, texels.columns][back] - GRAY).abs().mean() < 0.05


def test_nothing_changes_where_the_mirror_image_is_off_the_surface(ball: Ball) -> None:
    mesh, normals, texels = ball
    away = replace(ACROSS_DEPTH, point=torch.tensor([0.0, 0.0, 0.3]))
    texture, share = mirror_texture(mesh, [shown(mesh, normals)], away)
    back = texels.positions[:, 2] / texels.positions.norm(dim=1) < -0.5
    assert share == 0
    assert (texture[texels.rows, texels.columns][back] - GRAY).abs().mean() < 0.001


def test_a_mirror_image_colors_no_surface_that_faces_elsewhere(ball: Ball) -> None:
    """The mirror image of a small ball overlaps the ball, half of its size to one side."""
    mesh, normals, texels = ball
    small = replace(mesh, vertices=0.12 * mesh.vertices)
    across = torch.tensor([0.0, 0.5, 0.75**0.5])
    texture, share = mirror_texture(small, [shown(small, normals)], MirrorPlane(across, 0.06 * across, 1.0))
    change = (texture - mesh.texture)[texels.rows, texels.columns]
    assert share < 0.01
    assert change.abs().mean() < 0.005


def test_what_frames_show_beside_their_outline_keeps_its_color(ball: Ball) -> None:
    """A plane between the axes x and z takes the left outline of the ball to the middle of its front."""
    mesh, normals, texels = ball
    plane = MirrorPlane(torch.tensor([0.5**0.5, 0.0, 0.5**0.5]), torch.zeros(3), 1.0)
    texture, _ = mirror_texture(mesh, 16 * [shown(mesh, normals)], plane)
    towards = torch.nn.functional.normalize(OrbitCamera().position().float() - texels.positions, dim=-1)
    cosine = (texels.normals * towards).sum(-1)
    outline = (cosine > 0.15) & (cosine < 0.3) & (texels.normals[:, 0] < -0.8)
    change = (texture - mesh.texture)[texels.rows, texels.columns][outline]
    assert outline.sum() > 100
    assert change.abs().mean() < 0.1
