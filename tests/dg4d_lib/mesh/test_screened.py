"""Screened Laplace systems: conjugate gradients against a factorization."""

import numpy as np
import pytest
import trimesh

from dg4d_lib.mesh.neighbors import edge_graph, graph_laplacian, screened_factors
from dg4d_lib.mesh.screened import solve_screened


@pytest.mark.parametrize("least", [0.05, 0.5, 5.0])
def test_the_solution_is_that_of_a_factorization(least: float) -> None:
    ball, draws = trimesh.creation.icosphere(4), np.random.default_rng(0)
    vertices, edges = np.asarray(ball.vertices), edge_graph(np.asarray(ball.faces), len(ball.vertices))
    pull = least + draws.random(len(vertices))
    laplacian = graph_laplacian(edges)
    wanted = laplacian @ vertices + pull[:, None] * (vertices + 0.05 * draws.normal(size=vertices.shape))
    exact = screened_factors(laplacian, pull).solve(wanted)
    assert np.abs(exact - vertices).max() > 5e-3
    assert np.abs(solve_screened(edges, pull, wanted, vertices) - exact).max() < 1e-3
    assert np.array_equal(solve_screened(edges, pull, wanted, exact), exact)  # nothing is left to do


def test_columns_without_a_right_hand_side_stay_zero() -> None:
    ball = trimesh.creation.icosphere(2)
    edges = edge_graph(np.asarray(ball.faces), len(ball.vertices))
    wanted = np.zeros((len(ball.vertices), 3))
    wanted[0, 0] = 1
    solved = solve_screened(edges, np.ones(len(wanted)), wanted, np.zeros_like(wanted))
    assert solved[0, 0] > 0.1 and not solved[:, 1:].any()
