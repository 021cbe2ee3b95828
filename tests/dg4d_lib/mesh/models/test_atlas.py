"""One texture for all parts of a model: every point keeps its color."""

import numpy as np
import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.models.atlas import merge_parts
from dg4d_lib.mesh.models.model import Model, ModelPart, Wrap, sample_bilinear, to_srgb
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


LEFT_RED = np.zeros((16, 16, 4), np.uint8)
LEFT_RED[..., 3], LEFT_RED[:, :8, 0], LEFT_RED[:, 8:, 2] = 255, 255, 255  # and right blue
RED, BLUE = (1, 0, 0), (0, 0, 1)


@pytest.mark.parametrize(
    ("mode", "start", "left", "right"),
    [
        (Wrap.REPEAT, 1, RED, BLUE),
        (Wrap.MIRROR, 1, BLUE, RED),
        (Wrap.MIRROR, -1, BLUE, RED),
        (Wrap.MIRROR, 4, RED, BLUE),
        (Wrap.CLAMP, 1, BLUE, BLUE),
        (Wrap.CLAMP, -5, RED, RED),
    ],
)
def test_textures_go_on_by_their_wrap_mode(mode: Wrap, start: int, left: tuple[int, ...], right: tuple[int, ...]):
    for axis, (wrap, texture) in enumerate(
        (((mode, Wrap.CLAMP), LEFT_RED), ((Wrap.CLAMP, mode), LEFT_RED.swapaxes(0, 1)))
    ):
        along = np.roll(np.array([(0, 0.5), (1, 0.5), (1, 0.5), (0, 0.5)]) + np.array([start, 0]), axis, 1)
        part = ModelPart("a", SQUARE, FACES, along, texture, wrap=wrap)
        model = Model((part,))
        for column, x, expected in ((0.4, 0.3, left), (0.6, 0.7, right)):
            np.testing.assert_allclose(pixel(model, column, 0.5), expected, atol=0.02)
            color, _ = part.sample(np.array([0]), np.array([[1 - x, 0.5 * x, 0.5 * x]]))
            np.testing.assert_allclose(color[0], expected, atol=0.02)


def test_a_clamped_texture_ends_within_a_triangle():
    along = np.array([(-0.5, 0.5), (1.5, 0.5), (1.5, 0.5), (-0.5, 0.5)])
    model = Model((ModelPart("a", SQUARE, FACES, along, LEFT_RED, wrap=(Wrap.CLAMP, Wrap.REPEAT)),))
    for column, expected in ((0.3, RED), (0.45, RED), (0.55, BLUE), (0.7, BLUE)):
        np.testing.assert_allclose(pixel(model, column, 0.5), expected, atol=0.02)


def test_triangles_that_a_mask_hides_are_left_out_and_holes_have_the_color_around_them():
    texture = np.zeros((16, 16, 4), np.uint8)
    texture[:, :4] = (255, 0, 0, 255)
    shown, hidden = (np.array([(a, 1), (b, 1), (b, 0), (a, 0)], float) for a, b in ((0, 0.5), (0.5, 1)))
    left = ModelPart("a", SQUARE, FACES, shown, texture, masked=True)
    model = Model((left, ModelPart("b", SQUARE, FACES, hidden, texture, masked=True)))
    mesh, sources = merge_parts(model, 256)
    assert len(mesh.faces) == 2 and sources.max() < 4
    for column in (0.35, 0.65):
        np.testing.assert_allclose(pixel(model, column, 0.5), RED, atol=0.02)
    assert len(merge_parts(Model((ModelPart("b", SQUARE, FACES, hidden, texture),)), 256)[0].faces) == 2
    with pytest.raises(BadInput, match="transparent everywhere"):
        merge_parts(Model(model.parts[1:]), 256)


@pytest.mark.parametrize("masked", [False, True])
def test_more_repetitions_than_a_tile_has_become_the_mean_color(masked: bool):
    texture = np.zeros((16, 16, 4), np.uint8)
    texture[:, :8] = (255, 0, 255, 255)
    uvs = np.array([(0, 1), (9, 1), (9, 0), (0, 0)], float)
    mesh, _ = merge_parts(Model((ModelPart("a", SQUARE, FACES, uvs, texture, masked=masked),)), 256)
    level = 1.0 if masked else float(to_srgb(np.array(0.5)))
    texels = (mesh.uvs * torch.tensor(mesh.texture.shape[1::-1])).long()
    np.testing.assert_allclose(mesh.texture[texels[:, 1], texels[:, 0]], [(level, 0, level)] * 6, atol=1 / 255)


@pytest.mark.parametrize("wrap", list(Wrap))
def test_repetitions_keep_the_size_of_their_texture(wrap: Wrap):
    noise = np.random.default_rng(5).integers(0, 256, (16, 16, 4), np.uint8)
    uvs = np.array([(0, 2), (2, 2), (2, 0), (0, 0)], float)
    part = ModelPart("a", SQUARE, FACES, uvs, noise, wrap=(wrap, wrap))
    mesh, _ = merge_parts(Model((part,)), 256)
    places = np.random.default_rng(6).dirichlet((1, 1, 1), 20)
    chosen = np.zeros(20, np.int64)
    shown = np.einsum("nk,kc->nc", places, mesh.uvs[mesh.faces[0]].numpy().astype(float))
    found = sample_bilinear((255 * mesh.texture.numpy()).round().astype(np.uint8), shown) / 255
    np.testing.assert_allclose(found, part.sample(chosen, places)[0], atol=0.01)


def test_four_repetitions_stay_sharp():
    uvs = np.array([(0, 1), (4, 1), (4, 0), (0, 0)], float)
    mesh, _ = merge_parts(Model((ModelPart("a", SQUARE, FACES, uvs, LEFT_RED),)), 256)
    texels = mesh.uvs.numpy() * mesh.texture.shape[1::-1]
    for repeat in range(4):
        for share, expected in ((0.25, RED), (0.75, BLUE)):
            x, y = texels[0] + (texels[1] - texels[0]) * (repeat + share) / 4
            np.testing.assert_allclose(mesh.texture[int(y) - 1, int(x)], expected, atol=0.02)
