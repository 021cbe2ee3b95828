"""Motion of the skeleton that a model of another program has, fitted to the motion of the model's vertices.

Joints keep their distances and the weights that the model gives them. What they cannot do is left to morph targets.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from dg4d_lib.assets.formats.foreign_nodes import Matrices, skin_weights
from dg4d_lib.assets.formats.gltf import GlbReader
from dg4d_lib.mesh.tracking.articulation import Articulation, fit_rotations
from dg4d_lib.mesh.tracking.rig import rigid_maps

SAMPLE = 2000  # vertices, evenly chosen, that the motion is fitted to
ROUNDS = 6  # of the fit, of two Gauss-Newton steps each
CARRIED = 0.1  # of the weights below a joint that count for the rotation it starts from
UNEVEN = 1e-3  # largest deviation from a rotation of a node's matrix without its scale


@dataclass(frozen=True)
class SkeletonMotion:
    """Rigid motion of the joints of a model.

    Attributes:
        rest: global matrix of every node at rest.
        parents: parent of every node that has one.
        joints: nodes that move, parents before their children.
        maps: from the model at rest to the model at every frame, per joint.
    """

    rest: Matrices
    parents: dict[int, int]
    joints: tuple[int, ...]
    maps: Float[np.ndarray, "t k 4 4"]

    def globals(self, frame: int) -> Matrices:
        """Return the global matrix of every node at a frame; nodes below a joint move with it."""
        mover = self._movers()
        return {
            node: matrix if mover[node] is None else self.maps[frame, mover[node]] @ matrix
            for node, matrix in self.rest.items()
        }

    def tracks(self) -> dict[int, tuple[Float[np.ndarray, "t 3"], Float[np.ndarray, "t 3 3"], Float[np.ndarray, " 3"]]]:
        """Return translations, rotations and scale of every joint relative to its parent, at every frame.

        Raises:
            ValueError: the matrix of a joint is no rotation with a scale, as under parents that are scaled unevenly.
        """
        frames = [self.globals(frame) for frame in range(len(self.maps))]
        tracks = {}
        for joint in self.joints:
            local = np.stack([one[joint] for one in frames])
            if joint in self.parents:
                local = np.linalg.inv(np.stack([one[self.parents[joint]] for one in frames])) @ local
            scale = np.linalg.norm(local[0, :3, :3], axis=0)
            scale[0] *= np.sign(np.linalg.det(local[0, :3, :3]))
            turns = local[:, :3, :3] / scale
            if not np.abs(turns.swapaxes(1, 2) @ turns - np.eye(3)).max() < UNEVEN:
                raise ValueError(f"node {joint} is scaled unevenly")
            tracks[joint] = local[:, :3, 3], turns, scale
        return tracks

    def _movers(self) -> dict[int, int | None]:
        """Return the number of the joint that every node is, or is below of; parents come first in `rest`."""
        number = {joint: index for index, joint in enumerate(self.joints)}
        found: dict[int, int | None] = {}
        for node in self.rest:
            above = found[self.parents[node]] if node in self.parents else None
            found[node] = number.get(node, above)
        return found


@dataclass(frozen=True)
class SkinnedVertices:
    """Vertices of a primitive that joints move, in the coordinates of the model.

    Attributes:
        skin: of the node that shows the primitive.
        attributes: of the primitive.
        rest: vertices at rest.
        moved: vertices at every frame.
    """

    skin: dict[str, Any]
    attributes: dict[str, int]
    rest: Float[np.ndarray, "v 3"]
    moved: Float[np.ndarray, "t v 3"]


def fit_skeleton(reader: GlbReader, rest: Matrices, skinned: Sequence[SkinnedVertices]) -> SkeletonMotion | None:
    """Fit rotations of the joints, and the path of the whole, to moved vertices.

    Args:
        reader: of the file.
        rest: global matrix of every node, parents before their children.
        skinned: all vertices that joints move.

    Returns:
        The motion; None if there are no joints, or if it would not show more of the motion than none.
    """
    parents = {child: node for node in rest for child in reader.tree["nodes"][node].get("children", ())}
    used = {joint for one in skinned for joint in one.skin["joints"]}
    joints = tuple(node for node in rest if node in used)
    if not joints:
        return None
    step = max(1, sum(len(one.rest) for one in skinned) // SAMPLE)
    start = np.concatenate([one.rest[::step] for one in skinned]).astype(np.float64)
    moved = np.concatenate([one.moved[:, ::step] for one in skinned], 1).swapaxes(0, 1) - start[:, None]
    weights = np.concatenate([_weights_of_joints(reader, one, joints, step) for one in skinned])
    weights = np.pad(weights, ((0, 0), (1, 0)))  # none of the bone that all roots hang on
    known = weights.sum(1) > 0
    if not known.any():
        return None
    still = _at_rest(rest, parents, joints, moved.shape[1])
    maps = _fitted(still, start[known], moved[known], weights[known])
    if maps is None:
        return None
    matrices = np.tile(np.eye(4), (*maps.shape[:2], 1, 1))
    matrices[:, :, :3] += maps
    return SkeletonMotion(rest, parents, joints, matrices[1:].swapaxes(0, 1))


def _fitted(
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
            skeleton = fit_rotations(_ends_follow(skeleton, empty), rest, moved, weights)
    except np.linalg.LinAlgError:
        return None
    maps = _ends_follow(skeleton, empty).maps()
    shown = np.einsum("nk,ktij,nj->nti", weights, maps[..., :3], rest, optimize=True)
    shown += np.einsum("nk,kti->nti", weights, maps[..., 3])
    return maps if np.square(moved - shown).sum() < np.square(moved).sum() else None


def _at_rest(rest: Matrices, parents: dict[int, int], joints: tuple[int, ...], frames: int) -> Articulation:
    """Return the joints as bones at rest, below one more at their center that all roots hang on."""
    number = {joint: index for index, joint in enumerate(joints, 1)}
    above = []
    for joint in joints:
        node = parents.get(joint)
        while node is not None and node not in number:
            node = parents.get(node)
        above.append(0 if node is None else number[node])
    places = np.stack([rest[joint][:3, 3] for joint in joints])
    places = np.concatenate([places.mean(0, keepdims=True), places])
    still = np.tile(np.eye(3), (len(places), frames, 1, 1))
    return Articulation(np.array([-1, *above]), places, still, np.repeat(places[:1], frames, 0))


def _weights_of_joints(
    reader: GlbReader, skinned: SkinnedVertices, joints: tuple[int, ...], step: int
) -> Float[np.ndarray, "n k"]:
    """Return the weights of all joints at one vertex of every `step`."""
    number = {joint: index for index, joint in enumerate(joints)}
    columns: Int[np.ndarray, " s"] = np.array([number[joint] for joint in skinned.skin["joints"]])
    indices, weights = (rows[::step] for rows in skin_weights(reader, skinned.attributes))
    dense = np.zeros((len(indices), len(joints)))
    np.add.at(dense, (np.arange(len(indices))[:, None], columns[indices]), weights)
    return dense


def _ends_follow(skeleton: Articulation, empty: Bool[np.ndarray, " k"]) -> Articulation:
    """Let bones that move no vertex turn as their parents do."""
    rotations = skeleton.rotations.copy()
    for bone in np.flatnonzero(empty):
        if bone:
            rotations[bone] = rotations[skeleton.parents[bone]]
    return replace(skeleton, rotations=rotations)
