"""Control graphs: weights follow the surface, and separate components hang together."""

import numpy as np
import torch

from dg4d_lib.mesh.models.control_graph import build_control_graph, graph_of_points, point_graph


def strip(length: int, x: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return a strip of quads along y, 0.1 wide."""
    y = np.arange(length) * 0.05
    rows = [np.stack([np.full(length, x + dx), y, np.zeros(length)], 1) for dx in (0, 0.1)]
    k = np.arange(length - 1)
    faces = np.concatenate([np.stack([k, k + length, k + 1], 1), np.stack([k + 1, k + length, k + length + 1], 1)])
    return np.concatenate(rows), faces


def hairpin() -> tuple[np.ndarray, np.ndarray]:
    """Return two legs that nearly touch, joined at the top."""
    vertices, faces = strip(81)
    y = vertices[:, 1]
    right = y > 2
    return np.stack(
        [np.where(right, 0.11, 0.0) + vertices[:, 0] * 0, np.where(right, 4 - y, y), vertices[:, 0]], 1
    ), faces


def test_weights_are_shares():
    graph = build_control_graph(*hairpin(), 20)
    torch.testing.assert_close(graph.weights.sum(1), torch.ones(162))
    assert (graph.weights > 0).all()


def test_a_leg_does_not_move_with_the_one_that_it_touches():
    vertices, faces = hairpin()
    graph = build_control_graph(vertices, faces, 20)
    foot = (vertices[:, 1] < 1) & (vertices[:, 0] < 0.05)
    nodes = graph.nodes[graph.indices[torch.from_numpy(foot)]]
    heavy = graph.weights[torch.from_numpy(foot)] > 0.01
    assert (nodes[heavy][:, 0] < 0.05).all()


def test_separate_components_are_linked():
    body, eye = strip(30), strip(3, x=0.2)
    vertices = np.concatenate([body[0], eye[0]])
    faces = np.concatenate([body[1], eye[1] + len(body[0])])
    graph = build_control_graph(vertices, faces, 8)
    reached = {0}
    for _ in range(8):
        reached |= {b for a, b in graph.edges.tolist() if a in reached} | {
            a for a, b in graph.edges.tolist() if b in reached
        }
    assert len(reached) == len(graph.nodes)


def test_scattered_points_get_a_graph():
    points = np.random.default_rng(0).normal(size=(300, 3))
    graph = graph_of_points(points, point_graph(points), 30)
    assert graph.indices.max() < 30 and len(graph.nodes) == 30
    assert (graph.lengths > 0).all()


def test_more_nodes_than_points_are_no_error():
    assert len(build_control_graph(*strip(3), 100).nodes) == 6
