from pathlib import Path

import numpy as np
import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.video.framing import bounding_box, is_well_framed
from examples.drawing import draw
from examples.newt import Newt
from examples.shapes import Chain, ellipsoid, normals, skin, union
from steps.artifacts.media import read_png

FOLDER = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="module")
def newt() -> Newt:
    return Newt()


@pytest.mark.slow
def test_the_walk_is_a_loop(newt):
    np.testing.assert_allclose(newt.at(0.0), newt.at(1.0), atol=1e-9)


def test_every_part_of_the_newt_moves_but_nothing_jumps(newt):
    moved = np.linalg.norm(newt.at(0.25) - newt.at(0.75), axis=1)
    for part in (newt.skin.points[:, 0] > 0.5, newt.skin.points[:, 0] < -0.5, newt.skin.points[:, 1] < -0.25):
        assert moved[part].mean() > 0.02
    a_frame = np.linalg.norm(newt.at(1 / 24) - newt.at(0), axis=1)
    assert a_frame.max() < 0.15


def test_the_picture_in_the_repository_is_the_one_that_is_drawn(newt):
    stored = read_png(FOLDER / "newt.png")
    drawn = draw(newt, 0.0, OrbitCamera(width=128, height=128))
    small = torch.nn.functional.avg_pool2d((stored[..., :3] * stored[..., 3:]).permute(2, 0, 1)[None], 4)[0]
    error = (small.permute(1, 2, 0) - drawn[..., :3] * drawn[..., 3:]).abs().mean()
    assert error < 0.004


@pytest.mark.parametrize("name", ["newt.png", "beetle.png"])
def test_cutouts_lie_well_in_their_frames(name):
    picture = read_png(FOLDER / name)
    left, top, right, bottom = bounding_box(picture[None, ..., 3])
    assert picture.shape == (512, 512, 4)
    assert is_well_framed(picture[None, ..., 3])
    assert 0.7 < (right - left) / 512 < 0.95 and abs((top + bottom) / 2 - 256) < 40


@pytest.mark.parametrize("name", ["newt.png", "newt.mp4", "beetle.png"])
def test_examples_are_small(name):
    assert (FOLDER / name).stat().st_size < 300_000


def test_a_skin_is_closed_and_faces_outwards():
    ball = skin(ellipsoid((0.1, 0, 0), (0.2, 0.2, 0.2)), (-0.15, -0.25, -0.25), (0.35, 0.25, 0.25))
    edges = np.sort(np.concatenate([ball.faces[:, [0, 1]], ball.faces[:, [1, 2]], ball.faces[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    outward = ball.points - (0.1, 0, 0)
    np.testing.assert_allclose(np.linalg.norm(outward, axis=1), 0.2, atol=2e-3)
    assert (normals(ball.points, ball.faces) * outward).sum(1).min() > 0.19
    assert ball.openness.min() > 0.95


def test_a_chain_is_as_thick_as_its_joints_say():
    chain = Chain(np.array([(0.0, 0, 0), (1.0, 0, 0)]), np.array((0.2, 0.1)))
    np.testing.assert_allclose(chain(np.array([(0, 0.5, 0), (1, 0.5, 0), (0.5, 0.5, 0)])), (0.3, 0.4, 0.35), atol=1e-6)


def test_a_soft_union_only_adds_where_both_are_near():
    a, b = ellipsoid((0, 0, 0), (0.3, 0.3, 0.3)), ellipsoid((0.5, 0, 0), (0.3, 0.3, 0.3))
    points = np.array([(-0.3, 0, 0), (0.25, 0.25, 0)])
    soft, hard = union([a, b], 0.1)(points), np.minimum(a(points), b(points))
    assert soft[0] == hard[0] and soft[1] < hard[1] - 0.01
