"""Control graphs: weights follow the surface, and separate components hang together."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from dg4d_lib.mesh.models import control_graph
from dg4d_lib.mesh.models.control_graph import build_control_graph, graph_of_points, point_graph, surface_graph


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


def test_every_piece_is_joined_to_its_nearest_neighbor_by_few_searches(monkeypatch):
    searches = []
    monkeypatch.setattr(control_graph, "cKDTree", lambda *args, **options: searches.append(args) or cKDTree(*args))
    body, random = strip(40), np.random.default_rng(0)
    pieces = np.arange(300).repeat(3)
    vertices = random.normal(size=(300, 3))[pieces] + 0.02 * random.normal(size=(900, 3))
    points, labels = np.concatenate([body[0], vertices]), np.concatenate([np.full(len(body[0]), -1), pieces])
    faces = np.concatenate([body[1], np.arange(900).reshape(-1, 3) + len(body[0])])
    graph = surface_graph(points, faces).toarray()
    gaps = np.linalg.norm(points[:, None] - points, axis=-1) + np.where(labels[:, None] == labels, np.inf, 0)
    for piece in range(300):
        rows = np.flatnonzero(labels == piece)
        row, column = np.unravel_index(gaps[rows].argmin(), gaps[rows].shape)
        assert graph[rows[row], column] == pytest.approx(gaps[rows].min())
    assert len(searches) < 60


def test_scattered_points_get_a_graph():
    points = np.random.default_rng(0).normal(size=(300, 3))
    graph = graph_of_points(points, point_graph(points), 30)
    assert graph.indices.max() < 30 and len(graph.nodes) == 30
    assert (graph.lengths > 0).all()


def test_more_nodes_than_points_are_no_error():
    assert len(build_control_graph(*strip(3), 100).nodes) == 6


def tube(x: float, inside_out: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Return an open tube along y, 0.2 wide."""
    y, angle = np.meshgrid(np.linspace(0, 1, 21), np.arange(12) * np.pi / 6, indexing="ij")
    vertices = np.stack([x + 0.1 * np.cos(angle), y, 0.1 * np.sin(angle)], -1).reshape(-1, 3)
    row, column = np.meshgrid(np.arange(20), np.arange(12), indexing="ij")
    a, b = (row * 12 + column).ravel(), (row * 12 + (column + 1) % 12).ravel()
    faces = np.concatenate([np.stack([a, a + 12, b], 1), np.stack([b, a + 12, b + 12], 1)])
    return vertices, faces[:, ::-1] if inside_out else faces


@pytest.mark.parametrize("inside_out", [False, True])
def test_edges_run_through_the_inside_but_not_between_legs(inside_out):
    left, right = tube(0.0, inside_out), tube(0.25)  # 0.05 apart
    vertices = np.concatenate([left[0], right[0]])
    faces = np.concatenate([left[1], right[1] + len(left[0])])
    graph = build_control_graph(vertices, faces, 120)
    surface = graph_of_points(vertices, surface_graph(vertices, faces), 120)
    known = {tuple(pair) for pair in surface.edges.tolist()}
    added = graph.nodes[[pair for pair in graph.edges.tolist() if tuple(pair) not in known]]
    assert known <= {tuple(pair) for pair in graph.edges.tolist()} and len(added) > 60
    middle = added.mean(1)
    center = torch.where(middle[:, 0] < 0.125, 0.0, 0.25)
    assert (torch.stack([middle[:, 0] - center, middle[:, 2]], 1).norm(dim=1) < 0.1).all()  # inside
    assert ((added[:, 0, 0] < 0.125) == (added[:, 1, 0] < 0.125)).all()
