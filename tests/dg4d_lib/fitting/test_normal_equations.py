"""Normal equations of blocks equal those of the whole Jacobian."""

import numpy as np
import pytest

from dg4d_lib.fitting.normal_equations import NormalEquations

COUNT = 7


def jacobian(blocks: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return the matrix of the blocks, a row per residual."""
    items, _, height, _ = blocks.shape
    matrix = np.zeros((items, height, COUNT, 6))
    for item, ends in enumerate(nodes):
        for node, block in zip(ends, blocks[item], strict=True):
            matrix[item, :, node] += block
    return matrix.reshape(items * height, 6 * COUNT)


def expected_step(rows: list[np.ndarray], residuals: list[np.ndarray]) -> np.ndarray:
    """Return the step that numpy finds."""
    matrix, values = np.concatenate(rows), np.concatenate([each.ravel() for each in residuals])
    return np.linalg.lstsq(matrix, -values)[0].reshape(COUNT, 6)


def test_a_step_is_that_of_the_whole_jacobian() -> None:
    random = np.random.default_rng(0)
    equations, rows, residuals = NormalEquations(COUNT), [], []
    for items, ends, height in ((50, 4, 2), (20, 2, 3), (COUNT, 1, 3)):
        blocks = random.standard_normal((items, ends, height, 6))
        blocks[:, :, :, 1] = blocks[:, 0, 0, 2:] = 0  # entries that are skipped
        blocks[::2, :, :, 1] = 1
        nodes = random.integers(COUNT, size=(items, ends))  # one may be named twice
        values = random.standard_normal((items, height))
        equations.add(blocks, nodes, values)
        rows.append(jacobian(blocks, nodes))
        residuals.append(values)
    equations.add_sum(5, 0.7, -2.0)
    depth = np.zeros((1, COUNT, 6))
    depth[..., 5] = 0.7
    expected = expected_step([*rows, depth.reshape(1, -1)], [*residuals, np.array([-2.0])])
    np.testing.assert_allclose(equations.solve(), expected, atol=1e-7)


def test_arrays_in_any_memory_order_count_alike() -> None:
    random = np.random.default_rng(1)
    blocks, nodes = random.standard_normal((30, 2, 3, 6)), random.integers(COUNT, size=(30, 2))
    values = random.standard_normal((30, 3))
    steps = []
    for order in (np.ascontiguousarray, np.asfortranarray):
        equations = NormalEquations(COUNT)
        equations.add(order(blocks), order(nodes), order(values))
        steps.append(equations.solve())
    np.testing.assert_array_equal(*steps)


def test_nodes_without_residuals_stay() -> None:
    equations = NormalEquations(COUNT)
    equations.add(np.eye(6)[None, None], np.array([[2]]), np.full((1, 6), -3.0))
    expected = np.zeros((COUNT, 6))
    expected[2] = 3
    np.testing.assert_allclose(equations.solve(), expected, atol=1e-7)


def test_derivatives_that_are_not_finite_are_an_error() -> None:
    equations = NormalEquations(COUNT)
    equations.add(np.full((1, 1, 1, 6), np.nan), np.array([[0]]), np.ones((1, 1)))
    with pytest.raises(ValueError, match="infs or NaNs"):
        equations.solve()
