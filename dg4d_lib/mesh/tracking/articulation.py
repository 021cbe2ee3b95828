"""Articulated skeletons: bones that turn about joints of constant distance, fitted to a motion.

Bone b maps a rest point x to R_b (x - j_b) + p_b. The joint j_b also belongs to its parent a, which carries it:
p_b = p_a + R_a (j_b - j_a). Only rotations, the path of the root, and the joints at rest are free. Skinned vertices are
linear in the joints and in the root's path, and nearly linear in small rotations, so both are fitted in alternation.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

ANCHOR = 1e-3  # weight that keeps joints near their start, relative to the weight of the vertices below them
DAMPING = 1e-6  # of the rotations' Gauss-Newton steps, relative to the mean diagonal
STEPS = 2  # Gauss-Newton steps per call

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Articulation:
    """A tree of bones and its motion.

    Attributes:
        parents: parent of every bone, -1 for the first; parents come before their children.
        joints: at rest: "k 3".
        rotations: world rotation of every bone from rest: "k t 3 3".
        root: place of the first joint at every frame: "t 3".
    """

    parents: NDArray[np.int64]
    joints: Array
    rotations: Array
    root: Array

    def positions(self) -> Array:
        """Return the joints at every frame: "k t 3"."""
        places = np.repeat(self.root[None], len(self.joints), 0)
        for bone, parent in enumerate(self.parents[1:], 1):
            places[bone] = places[parent] + self.rotations[parent] @ (self.joints[bone] - self.joints[parent])
        return places

    def maps(self) -> Array:
        """Return the displacement of rest points by every bone, linear part and shift: "k t 3 4"."""
        shifts = self.positions() - (self.rotations @ self.joints[:, None, :, None])[..., 0]
        return np.concatenate((self.rotations - np.eye(3), shifts[..., None]), -1)

    def below(self, weights: Array) -> Array:
        """Return the weight of every bone with all its descendants: "n k"."""
        total = weights.copy()
        for bone in range(len(self.parents) - 1, 0, -1):
            total[:, self.parents[bone]] += total[:, bone]
        return total


def fit_joints(skeleton: Articulation, rest: Array, moved: Array, weights: Array, start: Array) -> Articulation:
    """Fit joints and the root's path by least squares, with all rotations fixed.

    Args:
        skeleton: where to start.
        rest: vertices "n 3".
        moved: their displacements at every frame "n t 3".
        weights: skinning weights "n k".
        start: joints "k 3" that regularize the fit where the motion does not determine it.
    """
    count, frames = skeleton.rotations.shape[:2]
    total = skeleton.below(weights)
    hinges = np.zeros_like(skeleton.rotations)  # effect of a joint at rest on all vertices below it
    hinges[1:] = skeleton.rotations[skeleton.parents[1:]] - skeleton.rotations[1:]
    missing = rest[:, None] + moved - _turned(skeleton, rest, weights)
    columns = hinges.transpose(1, 2, 0, 3).reshape(3 * frames, 3 * count)
    gram = (columns.T @ columns).reshape(count, 3, count, 3) * (total.T @ total)[:, None, :, None]
    cross = (total.sum(0)[:, None, None, None] * hinges).transpose(0, 3, 1, 2).reshape(3 * count, 3 * frames)
    matrix = np.block([[gram.reshape(3 * count, 3 * count), cross], [cross.T, len(rest) * np.eye(3 * frames)]])
    below = (total.T @ missing.reshape(len(rest), -1)).reshape(count, frames, 3)
    right = np.concatenate((np.einsum("ktai,kta->ki", hinges, below).ravel(), missing.sum(0).ravel()))
    anchor = np.repeat(ANCHOR * frames * np.maximum(total.sum(0), 1.0), 3)
    matrix[np.arange(3 * count), np.arange(3 * count)] += anchor
    right[: 3 * count] += anchor * start.ravel()
    found = np.linalg.solve(matrix, right)
    joints, shifts = found[: 3 * count].reshape(count, 3), found[3 * count :].reshape(frames, 3)
    return replace(skeleton, joints=joints, root=shifts + skeleton.rotations[0] @ joints[0])


def fit_rotations(skeleton: Articulation, rest: Array, moved: Array, weights: Array) -> Articulation:
    """Fit rotations and the root's path by Gauss-Newton steps, with joints and weights fixed."""
    count, frames = skeleton.rotations.shape[:2]
    total, sums, places = skeleton.below(weights), weights.sum(0), np.arange(3 * count)
    first = weights.T @ rest - sums[:, None] * skeleton.joints  # rest points around every joint, weighted
    around = weights[..., None] * (rest[:, None] - skeleton.joints)
    for _ in range(STEPS):
        positions = skeleton.positions()
        residuals = rest[:, None] + moved - _skinned(skeleton, rest, weights, positions)
        rotations, root = skeleton.rotations.copy(), skeleton.root.copy()
        for frame in range(frames):
            arms = np.einsum("kij,nkj->nki", skeleton.rotations[:, frame], around)  # of vertices about every joint
            reach = np.einsum("kij,kj->ki", skeleton.rotations[:, frame], first)
            steps = positions[1:, frame] - positions[skeleton.parents[1:], frame]
            for bone, parent in enumerate(skeleton.parents[1:], 1):
                arms[:, parent] += total[:, bone, None] * steps[bone - 1]
                reach[parent] += total[:, bone].sum() * steps[bone - 1]
            flat = arms.reshape(len(rest), -1)
            products = (flat.T @ flat).reshape(count, 3, count, 3)
            inner = np.einsum("kili->kl", products)[:, None, :, None] * np.eye(3)[None, :, None, :]
            matrix = np.zeros((3 * count + 3, 3 * count + 3))
            matrix[:-3, :-3] = (inner - products.transpose(0, 3, 2, 1)).reshape(3 * count, 3 * count)
            matrix[places, places] += DAMPING * np.trace(matrix) / (3 * count) + np.finfo(float).tiny
            matrix[:-3, -3:] = np.cross(reach[:, None], np.eye(3)).swapaxes(1, 2).reshape(-1, 3)
            matrix[-3:, :-3] = matrix[:-3, -3:].T
            matrix[-3:, -3:] = len(rest) * np.eye(3)
            residual = residuals[:, frame]
            turns = np.cross(arms, residual[:, None]).sum(0)
            step = np.linalg.solve(matrix, np.concatenate((turns.ravel(), residual.sum(0))))
            rotations[:, frame] = Rotation.from_rotvec(step[:-3].reshape(count, 3)).as_matrix() @ rotations[:, frame]
            root[frame] += step[-3:]
        skeleton = replace(skeleton, rotations=rotations, root=root)
    return skeleton


def _turned(skeleton: Articulation, rest: Array, weights: Array) -> Array:
    """Return the weighted means "n t 3" of the vertices, turned about the origin by every bone."""
    weighted = (weights[..., None] * rest[:, None]).reshape(len(rest), -1)
    columns = skeleton.rotations.transpose(0, 3, 1, 2).reshape(weighted.shape[1], -1)
    return np.asarray((weighted @ columns).reshape(len(rest), -1, 3))


def _skinned(skeleton: Articulation, rest: Array, weights: Array, positions: Array) -> Array:
    """Return the skinned vertices "n t 3"."""
    shifts = positions - (skeleton.rotations @ skeleton.joints[:, None, :, None])[..., 0]
    return _turned(skeleton, rest, weights) + (weights @ shifts.reshape(len(shifts), -1)).reshape(len(rest), -1, 3)
