"""One texture for all parts of a model: every point keeps its color."""

import numpy as np
import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.mesh.models.atlas import merge_parts
from dg4d_lib.mesh.models.model import Model, ModelPart, to_srgb
from dg4d_lib.mesh.render import render_mesh

SQUARE = np.array([(-0.5, -0.5, 0), (0.5, -0.5, 0), (0.5, 0.5, 0), (-0.5, 0.5, 0)], np.float32)
FACES = np.array([(0, 1, 2), (0, 2, 3)])
CHECKER = np.zeros((64, 64, 4), np.uint8)
CHECKER[:32, :32], CHECKER[32:, 32:] = (255, 0, 0, 255), (0, 255, 0, 255)


def pixel(model: Model, column: float, row: float) -> np.ndarray:
    """Return the color in the middle of a quarter of the square."""
    mesh, _ = merge_parts(model, 256)
    color, _ = render_mesh(mesh, [OrbitCamera(width=64, height=64)])
    return color[0, int(64 * row), int(64 * column)].numpy()


@pytest.mark.parametrize("shift", [0, 7, -3])
def test_a_texture_keeps_its_place_in_any_cell_of_its_repetition(shift: int):
    uvs = np.array([(0, 1), (1, 1), (1, 0), (0, 0)], float) + shift
    model = Model((ModelPart("a", SQUARE, FACES, uvs, CHECKER),))
    np.testing.assert_allclose(pixel(model, 0.4, 0.4), (1, 0, 0), atol=0.02)
    np.testing.assert_allclose(pixel(model, 0.6, 0.6), (0, 1, 0), atol=0.02)
    np.testing.assert_allclose(pixel(model, 0.6, 0.4), (0, 0, 0), atol=0.02)


def test_a_repeated_texture_is_repeated():
    uvs = np.array([(0, 2), (2, 2), (2, 0), (0, 0)], float)
    model = Model((ModelPart("a", SQUARE, FACES, uvs, CHECKER),))
    for column, row in ((0.31, 0.31), (0.55, 0.31), (0.31, 0.55)):
        np.testing.assert_allclose(pixel(model, column, row), (1, 0, 0), atol=0.1)


def test_colors_of_vertices_are_interpolated():
    colors = np.array([(1.0, 0, 0), (0, 1.0, 0), (0, 0, 1.0), (1.0, 1.0, 1.0)])
    model = Model((ModelPart("a", SQUARE, FACES, colors=colors),))
    mesh, sources = merge_parts(model, 256)
    assert sources.tolist() == FACES.ravel().tolist()
    corners = np.eye(3)[:2].repeat(2, 0)
    ours, _ = model.sample(np.array([0, 1, 0, 1]), corners)
    texels = (mesh.uvs * torch.tensor(mesh.texture.shape[1::-1])).long()
    found = mesh.texture[texels[:, 1], texels[:, 0]].numpy()
    np.testing.assert_allclose(found[[0, 3, 1, 4]], ours, atol=1 / 255)


@pytest.mark.parametrize("levels", [(0.5, 0.5, 0.5, 0.5), (0.2, 0.3, 0.8, 0.7)], ids=["uniform", "mean of corners"])
def test_vertex_colors_multiply_a_texture(levels: tuple[float, ...]):
    uvs, colors = np.array([(0, 1), (1, 1), (1, 0), (0, 0)], float), np.array(levels)[:, None] * (1.0, 0.5, 1.0)
    model = Model((ModelPart("a", SQUARE, FACES, uvs, CHECKER, (0.5, 1.0, 1.0), colors),))
    half_of_half = to_srgb(np.array(0.25))
    np.testing.assert_allclose(pixel(model, 0.4, 0.4), (half_of_half, 0, 0), atol=0.02)
    np.testing.assert_allclose(pixel(model, 0.6, 0.6), (0, half_of_half, 0), atol=0.02)


def test_a_texture_without_coordinates_is_not_used():
    model = Model((ModelPart("a", SQUARE, FACES, None, CHECKER, (1.0, 0.0, 0.0)),))
    np.testing.assert_allclose(pixel(model, 0.5, 0.5), (1, 0, 0), atol=0.02)


def test_parts_keep_their_own_colors():
    uvs = np.array([(0, 1), (1, 1), (1, 0), (0, 0)], float)
    white = np.full((8, 8, 4), 255, np.uint8)
    left = ModelPart("a", SQUARE - np.float32([0.55, 0, 0]), FACES, uvs, white, (1.0, 0.0, 0.0))
    right = ModelPart("b", SQUARE + np.float32([0.55, 0, 0]), FACES, factor=(0.0, 0.0, 1.0))
    model = Model((left, right))
    np.testing.assert_allclose(pixel(model, 0.3, 0.5), (1, 0, 0), atol=0.02)
    np.testing.assert_allclose(pixel(model, 0.7, 0.5), (0, 0, 1), atol=0.02)
