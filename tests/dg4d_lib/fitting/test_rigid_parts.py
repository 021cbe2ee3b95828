"""Few rigid parts: found where they explain a motion, with the rigid motions of least squares, else not found."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from dg4d_lib.fitting.node_motion import NodeMotion
from dg4d_lib.fitting.rigid_parts import RigidMotion, _Moments, find_rigid_parts, keep_pieces_rigid
from dg4d_lib.mesh.models.control_graph import ControlGraph

FRAMES = 5


def grid_graph(points: torch.Tensor) -> ControlGraph:
    """Return 6 x 4 nodes in a plane, joined to their neighbors, each moving the points nearest to it."""
    rows, columns = torch.meshgrid(torch.arange(6), torch.arange(4), indexing="ij")
    nodes = torch.stack([0.1 * columns.float(), 0.1 * rows.float(), torch.zeros(6, 4)], -1).reshape(-1, 3)
    index = torch.arange(24).view(6, 4)
    edges = torch.cat(
        [
            torch.stack([index[1:].ravel(), index[:-1].ravel()], 1),
            torch.stack([index[:, 1:].ravel(), index[:, :-1].ravel()], 1),
        ]
    )
    nearest = torch.cdist(points, nodes).argmin(1, keepdim=True)
    lengths = (nodes[edges[:, 0]] - nodes[edges[:, 1]]).norm(dim=1)
    return ControlGraph(nodes, nearest, torch.ones(len(points), 1), edges, lengths)


@pytest.fixture
def points() -> torch.Tensor:
    return torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([0.3, 0.5, 0.1])


def lid(graph: ControlGraph) -> RigidMotion:
    """Return a box that moves back while its lid, the upper two rows, opens about the edge between them."""
    parts = (graph.nodes[:, 1] > 0.35).long()
    angles = torch.linspace(0, 2.0, FRAMES)
    quats = torch.zeros(FRAMES, 2, 4)
    quats[:, 0, 0] = 1
    quats[:, 1, 0], quats[:, 1, 1] = (angles / 2).cos(), (angles / 2).sin()
    centers = torch.tensor([[0.15, 0.15, 0.0], [0.15, 0.35, 0.0]])
    back = torch.stack([torch.zeros(FRAMES), torch.zeros(FRAMES), -0.02 * torch.arange(FRAMES)], -1)
    return RigidMotion(parts, centers, quats, centers + back[:, None])


def test_a_box_and_its_lid_are_two_parts_with_their_motions(points: torch.Tensor) -> None:
    graph = grid_graph(points)
    motion = lid(graph).of_nodes(graph)
    found = find_rigid_parts(motion, graph, points, 4)
    assert found is not None
    assert len(found.centers) == 2
    assert torch.equal(found.parts == found.parts[0], graph.nodes[:, 1] < 0.35)
    again = found.of_nodes(graph)
    assert torch.allclose(again.nodes(graph), motion.nodes(graph), atol=1e-5)
    assert torch.allclose(again.points(points, graph), motion.points(points, graph), atol=1e-5)


def test_what_moves_as_a_whole_is_one_part(points: torch.Tensor) -> None:
    graph = grid_graph(points)
    both = lid(graph)
    whole = RigidMotion(torch.zeros_like(both.parts), both.centers[:1], both.quats[:, 1:], both.places[:, :1])
    found = find_rigid_parts(whole.of_nodes(graph), graph, points, 4)
    assert found is not None
    assert found.parts.tolist() == [0] * 24


def test_what_bends_everywhere_has_no_few_parts(points: torch.Tensor) -> None:
    graph = grid_graph(points)
    time = torch.linspace(0, 1, FRAMES)[:, None]
    wave = 0.1 * time * (40 * graph.nodes[:, 1] + 25 * graph.nodes[:, 0]).sin()
    shifts = torch.stack([torch.zeros_like(wave), torch.zeros_like(wave), wave], -1)
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(FRAMES, 24, 1)
    motion = NodeMotion(quats, shifts, quats[:, 0], torch.zeros(FRAMES, 3))
    assert find_rigid_parts(motion, graph, points, 4) is None
    assert find_rigid_parts(motion, graph, points, 24) is not None


def test_errors_are_those_of_the_best_rotations() -> None:
    generator = np.random.default_rng(0)
    rest, moved = generator.normal(size=(9, 3)), generator.normal(size=(2, 9, 3))
    moments = _Moments.of(rest, moved, np.zeros(9, np.int64))
    expected, rotations = 0.0, []
    for state in moved:
        rotation, distance = Rotation.align_vectors(state - state.mean(0), rest - rest.mean(0))
        expected += distance**2
        rotations.append(rotation.as_matrix())
    assert moments.errors()[0] == pytest.approx(expected)
    assert np.allclose(moments.rotations()[0], np.stack(rotations))


def test_turns_of_a_change_are_angles_about_the_center(points: torch.Tensor) -> None:
    graph = grid_graph(points)
    still = lid(graph).at(slice(0, 1))
    change = torch.zeros(1, 2, 6)
    change[0, 1, 3] = 0.02  # radians about x
    change[0, 0, 2] = 0.3
    moved = still.changed(change).of_nodes(graph).nodes(graph)[0] - graph.nodes
    upper = graph.nodes[:, 1] > 0.35
    arm = graph.nodes[upper, 1] - 0.35
    assert torch.allclose(moved[upper, 2], arm * math.sin(0.02), atol=1e-6)
    assert torch.allclose(moved[~upper], torch.tensor([0.0, 0, 0.3]).expand(16, 3), atol=1e-6)


def test_pieces_nearly_of_one_part_move_with_it_alone(points: torch.Tensor) -> None:
    graph = grid_graph(points)
    parts = lid(graph).parts
    below, above = 15, 16  # nodes on both sides of the edge
    upper = parts[graph.indices[:, 0]] == 1
    blended = replace(
        graph,
        indices=torch.cat([graph.indices, torch.where(upper, below, above)[:, None]], 1),
        weights=torch.tensor([[0.95, 0.05]]).repeat(len(points), 1),
    )
    blended.weights[:3] = torch.tensor([0.2, 0.8])  # three points that the other part moves
    motion = lid(graph).of_nodes(graph)
    whole = motion.points(points, keep_pieces_rigid(blended, motion.parts, upper.long()))
    alone = replace(graph, indices=torch.where(upper, above, below)[:, None])
    torch.testing.assert_close(whole, motion.points(points, alone), atol=1e-6, rtol=0)
    assert not torch.allclose(whole, motion.points(points, blended), atol=0.01)


def test_pieces_of_several_parts_bend_as_before(points: torch.Tensor) -> None:
    graph = grid_graph(points)
    kept = keep_pieces_rigid(graph, lid(graph).parts, torch.zeros(len(points), dtype=torch.long))
    assert torch.equal(kept.indices, graph.indices)
    assert torch.equal(kept.weights, graph.weights)
