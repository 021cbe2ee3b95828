"""Motion of the skeleton that a model of another program has, fitted to the motion of the model's vertices.

Joints keep their distances and the weights that the model gives them. What they cannot reproduce is left
to morph targets.
"""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from dg4d_lib.assets.formats.foreign_nodes import Matrices
from dg4d_lib.mesh.tracking.articulation import Articulation, fit_rotations
from dg4d_lib.mesh.tracking.rig import rigid_maps

MOST_JOINTS = 256  # a body with hands has about 80; with 256, 32 frames take a minute
ROUNDS = 6  # rounds of the fit, two Gauss-Newton steps each
CARRIED = 0.1  # factor on the weights of descendants in the initial rotation of a joint
UNEVEN = 1e-3  # largest deviation from a rotation of a node's matrix without its scale


class SkeletonAtRest(Exception):
    """A skeleton cannot move; the message says why."""


@dataclass(frozen=True)
class SkinnedVertices:
    """Vertices that joints move, in the coordinates of the model.

    Attributes:
        joints: nodes of the skin.
        indices: joints of every vertex, as numbers in the skin.
        weights: of these joints, sum 1 or all 0.
        rest: vertices at rest.
        moved: vertices at every frame.
    """

    joints: Sequence[int]
    indices: Int[np.ndarray, "v s"]
    weights: Float[np.ndarray, "v s"]
    rest: Float[np.ndarray, "v 3"]
    moved: Float[np.ndarray, "t v 3"]


@dataclass(frozen=True)
class JointTrack:
    """Motion of a joint relative to its parent.

    Attributes:
        translations: at every frame.
        rotations: matrices at every frame.
        scale: along its axes, at all frames.
    """

    translations: Float[np.ndarray, "t 3"]
    rotations: Float[np.ndarray, "t 3 3"]
    scale: Float[np.ndarray, " 3"]


@dataclass(frozen=True)
class SkeletonMotion:
    """Rigid motion of the joints of a model.

    Attributes:
        rest: global matrix of every node at rest.
        parents: parent of every node that has one.
        movers: number of the joint that every node at or below one moves with.
        joints: nodes that move, parents before their children.
        maps: from the model at rest to the model at every frame, per joint.
    """

    rest: Matrices
    parents: Mapping[int, int]
    movers: dict[int, int]
    joints: tuple[int, ...]
    maps: Float[np.ndarray, "t k 4 4"]

    def matrices(self, node: int) -> Float[np.ndarray, "t 4 4"]:
        """Return the global matrix of a node at every frame."""
        if node not in self.movers:
            return np.tile(self.rest[node], (len(self.maps), 1, 1))
        moved: Float[np.ndarray, "t 4 4"] = self.maps[:, self.movers[node]] @ self.rest[node]
        return moved

    def track(self, joint: int) -> JointTrack:
        """Return the motion of a joint relative to its parent.

        Raises:
            SkeletonAtRest: its matrix is not a rotation with a scale, as below nodes that are scaled unevenly.
        """
        local = self.matrices(joint)
        try:
            if joint in self.parents:
                local = np.linalg.inv(self.matrices(self.parents[joint])) @ local
        except np.linalg.LinAlgError as error:
            raise SkeletonAtRest("an ancestor of its joints has a singular scale") from error
        scale = np.linalg.norm(local[0, :3, :3], axis=0)
        scale[0] *= np.sign(np.linalg.det(local[0, :3, :3]))
        with np.errstate(divide="ignore", invalid="ignore"):
            turns = local[:, :3, :3] / scale
        if not np.abs(turns.swapaxes(1, 2) @ turns - np.eye(3)).max() < UNEVEN:
            raise SkeletonAtRest("its nodes are scaled unevenly")
        return JointTrack(local[:, :3, 3], turns, scale)


def fit_skeleton(rest: Matrices, parents: Mapping[int, int], skinned: Sequence[SkinnedVertices]) -> SkeletonMotion:
    """Fit rotations of the joints, and the translation of the root, to moved vertices.

    Args:
        rest: global matrix of every node, parents before their children.
        parents: parent of every node that has one.
        skinned: the vertices, or some of them.

    Raises:
        SkeletonAtRest: there are no or too many joints, or they would not reproduce the motion better than no joints.
    """
    joints, movers, above = joints_and_movers(rest, parents, {joint for one in skinned for joint in one.joints})
    if len(joints) > MOST_JOINTS:
        raise SkeletonAtRest(f"it has {len(joints)} joints; at most {MOST_JOINTS} are animated")
    weights = [_weights_by_joint(one, movers, len(joints)) for one in skinned]
    if not any(one.any() for one in weights):
        raise SkeletonAtRest("it moves no vertex")
    start = np.concatenate([one.rest for one in skinned]).astype(np.float64)
    moved = np.concatenate([one.moved for one in skinned], 1).swapaxes(0, 1) - start[:, None]
    known = np.concatenate(weights).any(1)
    still = _rest_articulation(np.stack([rest[joint][:3, 3] for joint in joints]), above, moved.shape[1])
    padded = np.pad(np.concatenate(weights), ((0, 0), (1, 0)))  # the added root bone has no weights
    maps = _fit_bones(still, start[known], moved[known], padded[known])
    if maps is None:
        raise SkeletonAtRest("it cannot reproduce the motion of the video")
    matrices = np.tile(np.eye(4), (*maps.shape[:2], 1, 1))
    matrices[:, :, :3] += maps
    return SkeletonMotion(rest, parents, movers, joints, matrices[1:].swapaxes(0, 1))


def joints_and_movers(
    rest: Matrices, parents: Mapping[int, int], used: Set[int]
) -> tuple[tuple[int, ...], dict[int, int], list[int]]:
    """Return the joints, parents before their children; the number of the joint that a node moves with, if any; and
    the number of the joint above each joint, -1 for none.

    Args:
        rest: global matrix of every node, parents before their children.
        parents: parent of every node that has one.
        used: nodes that are joints of a skin.
    """
    joints = tuple(node for node in rest if node in used)
    number = {joint: index for index, joint in enumerate(joints)}
    movers: dict[int, int] = {}
    for node in rest:
        if node in number:
            movers[node] = number[node]
        elif parents.get(node) in movers:
            movers[node] = movers[parents[node]]
    return joints, movers, [movers.get(parents.get(joint, -1), -1) for joint in joints]


def _fit_bones(
    skeleton: Articulation,
    rest: Float[np.ndarray, "n 3"],
    moved: Float[np.ndarray, "n t 3"],
    weights: Float[np.ndarray, "n k"],
) -> Float[np.ndarray, "k t 3 4"] | None:
    """Return the displacements by all bones, from the bones at rest on; None if they are no better than none."""
    below = skeleton.below(weights)
    empty = below.sum(0) < 1e-9
    try:
        maps = rigid_maps(rest, moved, np.where(empty, 1.0, weights + CARRIED * below))
        center = skeleton.joints[0]
        root = center + maps[0, :, :, :3] @ center + maps[0, :, :, 3]
        skeleton = replace(skeleton, rotations=maps[..., :3] + np.eye(3), root=root)
        for _ in range(ROUNDS):
            skeleton = fit_rotations(_copy_parent_rotations(skeleton, empty), rest, moved, weights)
    except np.linalg.LinAlgError:
        return None
    maps = _copy_parent_rotations(skeleton, empty).maps()
    shown = np.einsum("nk,ktij,nj->nti", weights, maps[..., :3], rest, optimize=True)
    shown += np.einsum("nk,kti->nti", weights, maps[..., 3])
    return maps if np.square(moved - shown).sum() < np.square(moved).sum() else None


def _rest_articulation(places: Float[np.ndarray, "k 3"], above: Sequence[int], frames: int) -> Articulation:
    """Return the joints as bones in the rest pose, after a root bone at their center that parents all root joints."""
    joints = np.concatenate([places.mean(0, keepdims=True), places])
    still = np.tile(np.eye(3), (len(joints), frames, 1, 1))
    parents = np.array([-1, *(1 + one for one in above)])
    return Articulation(parents, joints, still, np.repeat(joints[:1], frames, 0))


def _weights_by_joint(skinned: SkinnedVertices, movers: Mapping[int, int], count: int) -> Float[np.ndarray, "v k"]:
    """Return the weights of every vertex for all `count` joints."""
    columns = np.array([movers[joint] for joint in skinned.joints])
    dense = np.zeros((len(skinned.indices), count))
    np.add.at(dense, (np.arange(len(dense))[:, None], columns[skinned.indices]), skinned.weights)
    return dense


def _copy_parent_rotations(skeleton: Articulation, empty: Bool[np.ndarray, " k"]) -> Articulation:
    """Give bones that move no vertex the rotations of their parents."""
    rotations = skeleton.rotations.copy()
    for bone in np.flatnonzero(empty):
        if bone:
            rotations[bone] = rotations[skeleton.parents[bone]]
    return replace(skeleton, rotations=rotations)
