import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.functional import conv2d, normalize

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.geometry.normals import vertex_normals
from dg4d_lib.mesh.render import render_mesh
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh.texturing.bake import PosedSurface, locate_texels
from dg4d_lib.mesh.texturing.footage import fit_texture
from dg4d_lib.mesh.texturing.unwrap import unwrap

SIZE, PIXELS = 96, 80
CAMERA = OrbitCamera(width=PIXELS, height=PIXELS)
TOWARDS = normalize(CAMERA.position(), dim=0).float()
GRAY = 0.5


@pytest.fixture(scope="module")
def ball(sphere: tuple[np.ndarray, np.ndarray]) -> TexturedMesh:
    """A gray sphere."""
    sources, corners, uvs = (torch.from_numpy(array) for array in unwrap(*sphere, SIZE))
    return TexturedMesh(torch.from_numpy(sphere[0])[sources], corners, uvs, torch.full((SIZE, SIZE, 3), GRAY))


def pattern(places: torch.Tensor) -> torch.Tensor:
    """A color of every place that changes over a third of the radius."""
    return 0.5 + 0.35 * torch.sin(12 * places)


def painted(mesh: TexturedMesh) -> TexturedMesh:
    texels = locate_texels(mesh.vertices, mesh.vertices, mesh.faces, mesh.uvs, SIZE)
    texture = mesh.texture.clone()
    texture[texels.rows, texels.columns] = pattern(texels.positions)
    return replace(mesh, texture=texture)


def turned(mesh: TexturedMesh, angle: float) -> torch.Tensor:
    """Vertices turned about the vertical axis."""
    c, s = math.cos(angle), math.sin(angle)
    return mesh.vertices @ torch.tensor([[c, 0, -s], [0, 1, 0], [s, 0, c]])


def frame_of(mesh: TexturedMesh, angle: float = 0.0, weight: float = 1.0) -> PosedSurface:
    """Render a turned mesh from the input camera."""
    vertices = turned(mesh, angle)
    color, alpha = render_mesh(replace(mesh, vertices=vertices), [CAMERA])
    return PosedSurface(vertices, vertex_normals(vertices, mesh.faces), color[0], alpha[0], weight)


def mismatch(mesh: TexturedMesh, other: TexturedMesh, towards: float) -> torch.Tensor:
    """Differences of texels whose normal has at least this cosine to the camera."""
    texels = locate_texels(mesh.vertices, mesh.vertices, mesh.faces, mesh.uvs, SIZE)
    facing = texels.normals @ TOWARDS >= towards
    shown = texels.rows[facing], texels.columns[facing]
    return (mesh.texture[shown] - other.texture[shown]).abs()


def test_a_pattern_comes_back_where_frames_show_it_and_the_rest_stays(ball: TexturedMesh) -> None:
    truth = painted(ball)
    fitted = replace(ball, texture=fit_texture(ball, [frame_of(truth, 0.1 * step) for step in range(-4, 5)]))
    assert mismatch(ball, truth, 0.7).mean() > 0.15
    assert mismatch(fitted, truth, 0.7).mean() < 0.03
    away = locate_texels(ball.vertices, ball.vertices, ball.faces, ball.uvs, SIZE)
    hidden = away.normals @ TOWARDS < -0.8
    assert hidden.sum() > 200
    assert (fitted.texture[away.rows[hidden], away.columns[hidden]] - GRAY).abs().max() < 0.02


def test_renders_come_closer_to_frames_than_an_average_of_their_colors(ball: TexturedMesh) -> None:
    truth = painted(ball)
    frames = [frame_of(truth, angle) for angle in (-0.2, -0.1, 0.0, 0.1, 0.2)]
    kernel = torch.full((3, 1, 5, 5), 1 / 25)
    soft = conv2d(truth.texture.movedim(-1, 0)[None], kernel, padding="same", groups=3)
    start = replace(ball, texture=soft[0].movedim(0, -1))

    def error(mesh: TexturedMesh) -> float:
        renders = [render_mesh(replace(mesh, vertices=frame.vertices), [CAMERA])[0][0] for frame in frames]
        pairs = zip(renders, frames, strict=True)
        return float(torch.stack([(render - frame.color).square().mean() for render, frame in pairs]).mean())

    assert error(replace(ball, texture=fit_texture(start, frames))) < 0.2 * error(start)


def test_frames_that_are_slightly_misplaced_add_no_weave(ball: TexturedMesh) -> None:
    truth = painted(ball)
    frames = [frame_of(truth, 0.1 * step) for step in range(-4, 5)]
    shifts = (0.03, -0.02, 0.01, -0.03, 0.02, -0.01, 0.03, -0.02, 0.01)
    misplaced = [
        replace(frame, vertices=turned(ball, 0.1 * step + shift))
        for frame, step, shift in zip(frames, range(-4, 5), shifts, strict=True)
    ]
    kernel = torch.tensor([[0.0, -1, 0], [-1, 4, -1], [0, -1, 0]]).expand(3, 1, 3, 3)
    facing = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    texels = locate_texels(ball.vertices, ball.vertices, ball.faces, ball.uvs, SIZE)
    facing[texels.rows, texels.columns] = texels.normals @ TOWARDS > 0.6
    inside = conv2d(facing[None, None].float(), torch.ones(1, 1, 3, 3), padding=1)[0, 0] == 9

    def roughness(texture: torch.Tensor) -> float:
        return float(conv2d(texture.movedim(-1, 0)[None], kernel, padding=1, groups=3)[0, :, inside].square().mean())

    assert roughness(fit_texture(truth, misplaced)) < 1.9 * roughness(truth.texture)


def test_nothing_of_a_background_enters_where_the_mesh_is_too_large(ball: TexturedMesh) -> None:
    frame = frame_of(ball)
    left = (torch.arange(PIXELS) < PIXELS // 2)[None, :, None]
    cut = replace(frame, color=torch.where(left, frame.color, 1.0), alpha=torch.where(left, frame.alpha, 0.0))
    assert (fit_texture(ball, [cut]) - GRAY).abs().max() < 0.01


def test_of_two_frames_that_differ_the_heavier_one_counts(ball: TexturedMesh) -> None:
    frame = frame_of(ball)
    red = replace(frame, color=torch.tensor([0.9, 0.1, 0.1]).expand_as(frame.color))
    for weight, low, high in ((1.0, 0.45, 0.55), (0.05, 0.80, 0.9)):
        blue = replace(frame, color=torch.tensor([0.1, 0.1, 0.9]).expand_as(frame.color), weight=weight)
        fitted = replace(ball, texture=fit_texture(ball, [red, blue]))
        seen = mismatch(fitted, replace(ball, texture=torch.zeros_like(ball.texture)), 0.9)
        assert low < float(seen[:, 0].mean()) < high


def test_without_a_frame_that_shows_the_mesh_nothing_changes(ball: TexturedMesh) -> None:
    unseen = replace(frame_of(ball), alpha=torch.zeros(PIXELS, PIXELS, 1))
    for footage in ([], [unseen]):
        assert torch.equal(fit_texture(ball, footage), ball.texture)
