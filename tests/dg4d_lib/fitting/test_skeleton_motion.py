"""Motion of skinned models by their skeletons."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.sparse import csr_array

from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.fitting import skeleton_motion
from dg4d_lib.fitting.asset_pose import Placement
from dg4d_lib.fitting.skeleton_motion import (
    JointChains,
    JointVariables,
    fit_skeleton_motion,
    pose_model,
    skeleton_iterations,
)
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.quaternion import quat_multiply, quat_to_rotmat
from dg4d_lib.mesh.models.model import Model, ModelPart
from dg4d_lib.mesh.models.skeleton import INFLUENCES, JointGraph, Skeleton, joint_graph
from dg4d_lib.mesh.models.surface_cloud import SurfaceCloud, cover_surface
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.video.driving import DrivingVideo

RASTERIZE = get_rasterizer("cpu")
SETTINGS = AssetSettings(size=48, points=1500, fit_points=1500, joint_iterations=10, joint_frames=4, across=0)
COUNT = 13  # vertices along the arm


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"RATES": (0.06, 0.02), "TRACKED": 20, "TRUED": 6}.items():
        monkeypatch.setattr(skeleton_motion, name, value)


def arm() -> tuple[Model, Skeleton]:
    """Return an arm along x from -0.4 to 0.4, red, then blue, with joints at its left end and in its middle."""
    x = np.linspace(-0.4, 0.4, COUNT)
    around = [(-0.1, -0.1), (0.1, -0.1), (0.1, 0.1), (-0.1, 0.1)]
    vertices = np.concatenate([np.stack([x, np.full(COUNT, y), np.full(COUNT, z)], 1) for y, z in around])
    vertices = vertices.astype(np.float32)
    sides = [(COUNT * side, COUNT * ((side + 1) % 4)) for side in range(4)]
    quads = [(a + k, b + k, b + k + 1, a + k + 1) for a, b in sides for k in range(COUNT - 1)]
    faces = np.array([corners for a, b, c, d in quads for corners in ((a, b, c), (a, c, d))])
    colors = np.where(vertices[:, :1] < 0, [[0.8, 0.1, 0.1]], [[0.1, 0.1, 0.8]])
    part = ModelPart("arm", vertices, faces, colors=colors)
    forearm = (vertices[:, 0] > 0).astype(float)
    weights = csr_array(np.stack([1 - forearm, forearm], 1))
    return Model((part,)), Skeleton(np.array([(-0.4, 0.0, 0.0), (0.0, 0.0, 0.0)]), np.array([-1, 0]), weights)


def prepared() -> tuple[SurfaceCloud, JointGraph]:
    model, skeleton = arm()
    surface = cover_surface(model, SETTINGS.points, torch.Generator().manual_seed(0))
    return surface, joint_graph(skeleton, surface, model.faces, np.eye(4))


def turned(angles: list[float]) -> JointVariables:
    """Return the arm with its forearm turned about z by angles, in radians, at as many frames."""
    turns = torch.zeros(len(angles), 3, 3)
    turns[:, 2, 2] = torch.tensor([2 * math.tan(angle / 2) for angle in angles])
    return JointVariables(turns, *(torch.zeros(len(angles), count) for count in (3, 2, 1)))


def drawn(cloud: Gaussians, joints: JointGraph, variables: JointVariables) -> DrivingVideo:
    motion = JointChains(joints).motion(variables)
    means, quats = motion.points(cloud.means, joints.graph), motion.rotations(joints.graph)
    frames, alphas = [], []
    for moved, turn in zip(means, quats, strict=True):
        state = replace(cloud, means=moved, quats=quat_multiply(turn, cloud.quats))
        picture = RASTERIZE(state, [OrbitCamera(width=96, height=96)], torch.zeros(3))
        frames.append((picture.color[0] / picture.alpha[0].clamp(min=1e-3)).clamp(0, 1))
        alphas.append(picture.alpha[0])
    return DrivingVideo(torch.stack(frames), torch.stack(alphas), 12.0)


def test_a_child_turns_about_its_joint_and_follows_its_parent():
    _, joints = prepared()
    variables = turned([math.pi / 2])
    variables.turns[0, 1, 2] = 2.0  # the upper arm, by 90 degrees, too
    variables.global_depth[0] = 0.1
    motion = JointChains(joints).motion(variables)
    tip, middle = torch.tensor([[0.4, 0.0, 0.0], [-0.2, 0.0, 0.0]])
    graph = replace(joints.graph, indices=torch.tensor([[2], [1]]), weights=torch.ones(2, 1))
    moved = motion.points(torch.stack([tip, middle]), graph)[0]
    torch.testing.assert_close(moved[1], torch.tensor([-0.4, 0.2, 0.1]), atol=1e-6, rtol=0)
    torch.testing.assert_close(moved[0], torch.tensor([-0.8, 0.4, 0.1]), atol=1e-6, rtol=0)
    stretched = motion.nodes(joints.graph)[0].diff(dim=0).norm(dim=-1)
    torch.testing.assert_close(stretched, joints.graph.nodes.diff(dim=0).norm(dim=-1))


def test_joints_that_move_nothing_follow_their_parents():
    model, skeleton = arm()
    idle = replace(
        skeleton,
        places=np.concatenate([skeleton.places, [(0.4, 0.0, 0.0)]]),
        parents=np.array([-1, 0, 1]),
        weights=csr_array(np.pad(skeleton.weights.toarray(), ((0, 0), (0, 1)))),
    )
    surface = cover_surface(model, 100, torch.Generator().manual_seed(0))
    joints = joint_graph(idle, surface, model.faces, np.eye(4))
    assert joints.turning.tolist() == [True, True, True, False]
    still = JointVariables.still(joints)
    motion = JointChains(joints).motion(replace(still, turns=torch.ones_like(still.turns)))
    torch.testing.assert_close(motion.quats[:, 3], motion.quats[:, 2])


def test_weights_are_interpolated_and_what_no_joint_moves_follows_the_whole():
    model, skeleton = arm()
    weights = skeleton.weights.toarray()
    weights[::COUNT] = 0
    surface = cover_surface(model, 100, torch.Generator().manual_seed(0))
    graph = joint_graph(replace(skeleton, weights=csr_array(weights)), surface, model.faces, np.eye(4)).graph
    dense = torch.zeros(len(graph.indices), 3).scatter_(1, graph.indices, graph.weights)
    torch.testing.assert_close(dense.sum(1), torch.ones(len(dense)))
    x = torch.from_numpy(surface.fine.vertices[:, 0]).float()
    step = 0.8 / (COUNT - 1)
    torch.testing.assert_close(dense[:, 2], (x / step).clamp(0, 1), atol=1e-5, rtol=0)
    assert (dense[x <= -0.4 + 1e-6, 0] == 1).all() and (dense[x > -0.4 + step, 0] == 0).all()


def test_many_influences_are_reduced_to_the_heaviest():
    model, _ = arm()
    many = csr_array(np.tile(np.linspace(1, 2, 12) / 18, (4 * COUNT, 1)))
    places, parents = np.zeros((12, 3)), np.array([-1] * 12)
    surface = cover_surface(model, 100, torch.Generator().manual_seed(0))
    graph = joint_graph(Skeleton(places, parents, many), surface, model.faces, np.eye(4)).graph
    assert graph.indices.shape[1] == INFLUENCES
    assert set(graph.indices[0].tolist()) == set(range(5, 13))
    torch.testing.assert_close(graph.weights.sum(1), torch.ones(len(graph.weights)))


@pytest.mark.parametrize("angle", [0.1, 1.0])
def test_a_pose_far_from_rest_is_found_and_corrects_the_placement(angle):
    surface, joints = prepared()
    seen = joints.of(surface.nearest)
    truth = turned([angle])
    truth.global_shift[0], truth.global_depth[0] = torch.tensor([0.02, -0.01]), 0.1
    video = drawn(surface.cloud, seen, truth)
    subject = torch.cat([video.frames[0], video.alpha[0]], -1)
    placement = Placement(torch.tensor([1.0, 0, 0, 0]), 1.0, torch.zeros(3), agreement=0.3)
    found = pose_model(surface.cloud, seen, subject, placement, RASTERIZE, SETTINGS)
    assert found.placement.agreement > 0.9
    assert found.placement.scale == pytest.approx(2 / 1.9, abs=0.02)  # as much larger as it is nearer
    means = JointChains(joints).motion(truth).points(surface.cloud.means, seen.graph)[0]
    assert float((found.cloud.means - means)[:, :2].norm(dim=-1).mean()) < 0.02


def test_the_motion_of_the_forearm_is_found():
    surface, joints = prepared()
    seen = joints.of(surface.nearest)
    truth = turned([0.9, 0.6, 0.3, 0.0, -0.3])
    video = drawn(surface.cloud, seen, truth)
    steps: list[int] = []
    motion = fit_skeleton_motion(
        surface.cloud, seen, video, RASTERIZE, SETTINGS, torch.Generator().manual_seed(0), lambda k, _: steps.append(k)
    )
    assert steps == list(range(1, skeleton_iterations(SETTINGS, 5) + 1))
    points = torch.from_numpy(surface.fine.vertices).float()
    expected = JointChains(joints).motion(truth).points(points, joints.graph)
    found = motion.points(points, joints.graph)
    off = (found - expected).abs().mean((0, 1))
    assert off[:2].max() < 0.015 and off[2] < 0.06  # one picture tells depth from perspective only
    lengths = motion.nodes(joints.graph).diff(dim=1).norm(dim=-1)
    torch.testing.assert_close(lengths, lengths[:1].expand_as(lengths))
    matrices = quat_to_rotmat(motion.quats)
    torch.testing.assert_close(matrices @ matrices.mT, torch.eye(3).expand_as(matrices), atol=1e-5, rtol=0)
