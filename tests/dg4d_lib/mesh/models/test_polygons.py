"""Triangulation of polygons: triangles fill the polygon and nothing else."""

import numpy as np
import pytest

from dg4d_lib.mesh.models.polygons import triangulate

ELL = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], float)  # an L, of area 3
TURN = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]


def in_space(outline: np.ndarray) -> np.ndarray:
    return np.pad(outline, ((0, 0), (0, 1))) @ TURN.T + (3.0, -2.0, 5.0)


def areas(points: np.ndarray, triangles: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the areas of triangles, positive if they have the orientation of the polygon."""
    a, b, c = points[triangles].swapaxes(0, 1)
    return 0.5 * np.cross(b - a, c - a) @ normal


@pytest.mark.parametrize("turned", [1, -1], ids=["counter-clockwise", "clockwise"])
@pytest.mark.parametrize("start", range(6))
def test_a_concave_polygon_keeps_its_notch_from_any_corner(start: int, turned: int) -> None:
    points = in_space(np.roll(ELL, -start, 0)[::turned])
    found = areas(points, triangulate(points, np.arange(6), np.array([6])), turned * TURN[:, 2] * np.linalg.det(TURN))
    assert (found > -1e-9).all() and np.abs(found).sum() == pytest.approx(3)


def test_polygons_keep_their_order_and_convex_ones_are_fans() -> None:
    arrow = np.array([(0, 1), (-1, -1), (0, 0), (1, -1)], float)  # a fan from the first corner would be right, too
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    points = in_space(np.concatenate([square, np.roll(arrow, -1, 0), square]))
    triangles = triangulate(points, np.arange(12), np.array([4, 2, 1, 1, 4]))
    np.testing.assert_array_equal(triangles[[0, 1, 2, 3]], [(0, 1, 2), (0, 2, 3), (8, 9, 10), (8, 10, 11)])
    triangles = triangulate(points, np.arange(12), np.array([4, 4, 4]))
    assert [set(row // 4) for row in triangles] == [{0}, {0}, {1}, {1}, {2}, {2}]
    assert np.abs(areas(points, triangles, TURN[:, 2])).sum() == pytest.approx(1 + 1 + 1)


def test_stars_and_holes_are_filled_without_overlap() -> None:
    angles = np.arange(40) * np.pi / 20
    star = np.where(np.arange(40) % 2, 1.0, 3.0)[:, None] * np.stack([np.cos(angles), np.sin(angles)], 1)
    ring = np.array([(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)], float)
    for outline, area in ((star, 40 * 0.5 * 3 * np.sin(np.pi / 20)), (ring, 12)):
        points = in_space(outline)
        triangles = triangulate(points, np.arange(len(points)), np.array([len(points)]))
        assert len(triangles) == len(points) - 2
        assert np.abs(areas(points, triangles, TURN[:, 2])).sum() == pytest.approx(area)


@pytest.mark.parametrize("start", range(5))
def test_a_corner_may_be_there_twice(start: int) -> None:
    arrow = np.array([(0, 1), (-1, -1), (0, 0), (0, 0), (1, -1)], float)
    points = in_space(np.roll(arrow, -start, 0))
    found = areas(points, triangulate(points, np.arange(5), np.array([5])), TURN[:, 2])
    assert np.abs(found).sum() == pytest.approx(1)


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_polygons_without_a_plane_have_as_many_triangles(value: float) -> None:
    assert triangulate(np.full((5, 3), value), np.arange(5), np.array([5])).shape == (3, 3)


def test_no_polygons_have_no_triangles() -> None:
    assert triangulate(np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64)).shape == (0, 3)
