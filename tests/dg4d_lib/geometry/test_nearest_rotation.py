"""The rotation nearest to a matrix, beside a singular value decomposition, and for degenerate matrices."""

import numpy as np
import pytest

from dg4d_lib.geometry.rotation import nearest_rotation

RANDOM = np.random.default_rng(0)


def nearest(matrix: np.ndarray) -> np.ndarray:
    rotation = np.empty((3, 3))
    nearest_rotation(matrix, rotation)
    return rotation


def by_singular_values(matrix: np.ndarray) -> np.ndarray:
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt


@pytest.mark.parametrize("size", [1e-200, 1e-6, 1.0, 1e200])
def test_it_is_that_of_the_singular_value_decomposition(size: float):
    for matrix in RANDOM.normal(size=(100, 3, 3)):
        np.testing.assert_allclose(nearest(size * matrix), by_singular_values(matrix), atol=1e-6)


@pytest.mark.parametrize(
    "matrix",
    [
        np.zeros((3, 3)),
        np.outer([1.0, 2, 3], [3.0, 1, 2]),
        np.diag([1.0, 2, 0]),
        -np.eye(3),
        np.diag([1.0, 1, -1]),
        np.diag([-3.0, 2, 1]),
    ],
)
def test_degenerate_matrices_and_reflections_get_one_of_the_nearest(matrix: np.ndarray):
    rotation = nearest(matrix)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    assert (rotation * matrix).sum() == pytest.approx((by_singular_values(matrix) * matrix).sum())


def test_nan_is_not_hidden():
    one = np.eye(3)
    one[0, 1] = np.nan
    assert np.isnan(nearest(one)).any()
    assert np.isnan(nearest(np.full((3, 3), np.nan))).any()
