from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dg4d_lib.mesh.tracking.articulation import Articulation, fit_joints, fit_rotations

FRAMES, PARENTS = 7, np.array([-1, 0, 1, 1])
JOINTS = np.array([[0.0, 0, 0], [1.0, 0.1, 0], [2.0, 0, 0.3], [1.2, 1.0, 0]])


@pytest.fixture(scope="module")
def skeleton() -> Articulation:
    """Four bones that turn smoothly while the root walks."""
    time = np.linspace(0, 1, FRAMES)
    turns = np.random.default_rng(0).normal(size=(4, 1, 3)) * np.sin(np.pi * time)[None, :, None]
    rotations = Rotation.from_rotvec(0.6 * turns.reshape(-1, 3)).as_matrix().reshape(4, FRAMES, 3, 3)
    return Articulation(PARENTS, JOINTS, rotations, np.stack([time, 0 * time, -0.5 * time], 1))


@pytest.fixture(scope="module")
def skinned(skeleton: Articulation) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices around the bones, their weights, and their displacements."""
    generator = np.random.default_rng(1)
    rest = generator.uniform((-0.5, -0.5, -0.5), (2.5, 1.5, 0.5), (300, 3))
    weights = np.exp(-8 * np.square(rest[:, None] - JOINTS).sum(-1)) + 1e-3
    weights /= weights.sum(1, keepdims=True)
    return rest, weights, moved(skeleton, rest, weights)


def moved(skeleton: Articulation, rest: np.ndarray, weights: np.ndarray) -> np.ndarray:
    homogeneous = np.concatenate((rest, np.ones((len(rest), 1))), 1)
    return np.einsum("nk,ktij,nj->nti", weights, skeleton.maps(), homogeneous)


def test_parents_carry_the_joints_of_their_children(skeleton: Articulation) -> None:
    places = skeleton.positions()
    for bone, parent in enumerate(PARENTS[1:], 1):
        length = np.linalg.norm(JOINTS[bone] - JOINTS[parent])
        np.testing.assert_allclose(np.linalg.norm(places[bone] - places[parent], axis=-1), length)
        by_parent = skeleton.maps()[parent] @ np.append(JOINTS[bone], 1) + JOINTS[bone]
        np.testing.assert_allclose(by_parent, places[bone], atol=1e-12)


def test_weights_below_a_bone_are_those_of_its_subtree(skeleton: Articulation) -> None:
    np.testing.assert_array_equal(skeleton.below(np.eye(4)).T, [[1, 1, 1, 1], [0, 1, 1, 1], [0, 0, 1, 0], [0, 0, 0, 1]])


def test_rotations_are_recovered(skeleton: Articulation, skinned: tuple[np.ndarray, ...]) -> None:
    rest, weights, goal = skinned
    off = Rotation.from_rotvec(np.random.default_rng(2).normal(0, 0.2, (4 * FRAMES, 3))).as_matrix()
    found = replace(skeleton, rotations=off.reshape(4, FRAMES, 3, 3) @ skeleton.rotations, root=skeleton.root + 0.1)
    for _ in range(4):
        found = fit_rotations(found, rest, goal, weights)
    np.testing.assert_allclose(found.rotations, skeleton.rotations, atol=1e-4)
    np.testing.assert_allclose(found.root, skeleton.root, atol=1e-4)


def test_joints_are_recovered(skeleton: Articulation, skinned: tuple[np.ndarray, ...]) -> None:
    rest, weights, goal = skinned
    found = fit_joints(replace(skeleton, joints=JOINTS + 0.1, root=0 * skeleton.root), rest, goal, weights, JOINTS)
    np.testing.assert_allclose(found.joints[1:], JOINTS[1:], atol=1e-3)
    np.testing.assert_allclose(moved(found, rest, weights), goal, atol=1e-3)


def test_joints_stay_where_the_motion_does_not_say_where_they_are(skinned: tuple[np.ndarray, ...]) -> None:
    """Nothing turns, so any joint would do."""
    rest, weights, _ = skinned
    still = Articulation(PARENTS, JOINTS, np.tile(np.eye(3), (4, FRAMES, 1, 1)), np.zeros((FRAMES, 3)))
    found = fit_joints(still, rest, np.zeros((len(rest), FRAMES, 3)), weights, JOINTS + 0.2)
    np.testing.assert_allclose(found.joints, JOINTS + 0.2)
    np.testing.assert_allclose(moved(found, rest, weights), 0, atol=1e-9)
