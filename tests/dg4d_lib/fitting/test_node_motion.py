"""Motions of nodes from variables: integrated rotations turn rigidly and swing limbs; poses are recovered."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial import Delaunay

from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.fitting.node_motion import NodeBasis, NodeMotion, NodeVariables
from dg4d_lib.fitting.node_pose import Pose
from dg4d_lib.geometry.quaternion import quat_to_rotmat
from dg4d_lib.mesh.models.control_graph import ControlGraph, build_control_graph, graph_of_points, point_graph

ANGLE = 1.0  # radians


@pytest.fixture(scope="module")
def plate() -> ControlGraph:
    """Return the graph of a plate from x = -1 to 1, in the plane of x and z."""
    x, z = np.meshgrid(np.linspace(-1, 1, 21), np.linspace(-0.2, 0.2, 5), indexing="ij")
    vertices = np.stack([x, 0.0 * x, z], -1).reshape(-1, 3)
    return build_control_graph(vertices, Delaunay(vertices[:, ::2]).simplices.astype(np.int64), 40, braced=False)


def quats_about_z(angles: torch.Tensor) -> torch.Tensor:
    zeros = torch.zeros_like(angles)
    return torch.stack([(angles / 2).cos(), zeros, zeros, (angles / 2).sin()], -1)[None]


def test_one_rotation_of_all_nodes_turns_them_about_their_centroid(plate: ControlGraph) -> None:
    quats = quats_about_z(torch.full((len(plate.nodes),), ANGLE))
    centered = plate.nodes - plate.nodes.mean(0)
    turned = centered @ quat_to_rotmat(quats[0, 0]).T
    torch.testing.assert_close(NodeBasis(plate, 1.0, True).integral(quats)[0], turned - centered, atol=1e-5, rtol=0)


def test_nodes_stay_where_rotations_are_not_integrated(plate: ControlGraph) -> None:
    quats = quats_about_z(torch.full((len(plate.nodes),), ANGLE))
    assert not NodeBasis(plate, 1.0, False).integral(quats).any()


def test_rotations_of_one_side_swing_it_and_keep_its_length(plate: ControlGraph) -> None:
    right = plate.nodes[:, 0] > 0
    quats = quats_about_z(ANGLE * right.float())
    moved = plate.nodes + NodeBasis(plate, 0.0, True).integral(quats)[0]
    tip, root = plate.nodes[:, 0].argmax(), torch.where(right, plate.nodes[:, 0], math.inf).argmin()
    before, after = plate.nodes[tip] - plate.nodes[root], moved[tip] - moved[root]
    assert float(after.norm() / before.norm()) == pytest.approx(1, abs=0.02)
    assert math.atan2(float(after[1]), float(after[0])) == pytest.approx(ANGLE, abs=0.03)


def test_a_quaternion_and_its_negative_are_one_rotation(plate: ControlGraph) -> None:
    count = len(plate.nodes)
    quats = quats_about_z(2.5 * plate.nodes[:, 0])  # from -143 to 143 degrees
    signs = torch.tensor([1.0, -1.0])[torch.arange(count) % 2, None]
    rest = torch.zeros(1, count, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1, 3)
    plain, mixed = (NodeMotion(one, *rest).rotations(plate) for one in (quats, signs * quats))
    torch.testing.assert_close(quat_to_rotmat(mixed), quat_to_rotmat(plain))


@pytest.mark.parametrize("integrated", [False, True])
def test_variables_of_a_pose_stand_for_it(plate: ControlGraph, integrated: bool) -> None:
    generator = np.random.default_rng(0)
    count = len(plate.nodes)
    turns = quat_to_rotmat(quats_about_z(torch.from_numpy(generator.normal(size=count)).float())[0]).double().numpy()
    pose = Pose(turns, generator.normal(size=(count, 3)))
    basis = NodeBasis(plate, 1.0, integrated)
    motion = NodeVariables.of(pose, basis).motion(basis)
    torch.testing.assert_close(motion.shifts[0], torch.from_numpy(pose.shifts).float(), atol=1e-4, rtol=0)
    torch.testing.assert_close(quat_to_rotmat(motion.quats[0]), torch.from_numpy(pose.turns).float(), atol=1e-4, rtol=0)


@pytest.mark.parametrize("nodes", [40, 100])
def test_variables_of_a_pose_stand_for_it_at_the_strongest_smoothing(nodes: int) -> None:
    strongest = AssetSettings.model_json_schema()["properties"]["smoothing"]["maximum"]
    points = np.random.default_rng(1).normal(size=(nodes, 3))
    graph = graph_of_points(points, point_graph(points), nodes)
    pose = Pose(np.tile(np.eye(3), (nodes, 1, 1)), np.random.default_rng(0).normal(size=(nodes, 3)))
    basis = NodeBasis(graph, strongest, integrated=False)
    motion = NodeVariables.of(pose, basis).motion(basis)
    torch.testing.assert_close(motion.shifts[0], torch.from_numpy(pose.shifts).float(), atol=0.01, rtol=0)
