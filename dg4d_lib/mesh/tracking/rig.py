"""Rigging of a vertex animation: a skeleton with few bones, and skinning weights.

Smooth skinning decomposition with rigid bones (SSDR, Le and Deng 2012); their p, v, B and w are `rest`, `moved`, `maps`
and `weights` here. Weights are convex with at most four bones per vertex. Vertices are first clustered by common rigid
motions; then weights and bone motions are optimized in alternation, each exactly with the other fixed. At last the
bones are joined to a skeleton whose bones keep their lengths, unless the motion tears it. The algorithm is
deterministic.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.spatial.transform import Rotation
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.geometry.quaternion import quat_to_rotmat
from dg4d_lib.mesh.tracking.articulation import Articulation, fit_joints, fit_rotations

INFLUENCES = 4  # bones per vertex, the number that every glTF player supports
GROWTH = 1.4  # ratio of successive trial numbers of bones
CLUSTERING = 4  # k-means rounds after clusters were split
ROUNDS = 8  # maximum alternations of weights and bones
CONVERGED = 0.01  # relative decrease of the residual below which the alternation stops
SAMPLE = 2000  # vertices on which numbers of bones are tried
SPLIT = 0.2  # share of a cluster's vertices, those around the worst one, that start a new cluster
STIFF = 1e-9  # Tikhonov weight towards zero rotation, relative to the spread of the vertices
APART = 1e-6  # added to distances and shared weights, so that bones without shared vertices are joined last
WORTH = 1.0  # decrease of a vertex's root mean square error that justifies a further bone, in target residuals
ARTICULATIONS = 6  # alternations of joints, rotations and weights of a skeleton whose bones keep their lengths
LOOSEST = 2.0  # residual of such a skeleton relative to that of free bones, above which bones may stretch
EXACT = 1e-7  # residual relative to the mesh size below which a fit is exact in float32
CHUNK = 2048  # vertices per batch of the weight solver; bounds memory

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rig:
    """Skeleton, its animation and the skinning weights of a mesh (linear blend skinning).

    Bone b maps a rest point x to R(quats[t, b]) (x - rest_positions[b]) + positions[t, b] at frame t; a vertex is the
    weighted mean over its bones.

    Attributes:
        rest_positions: joints at rest, world units.
        parents: parent of every bone, -1 for the root; parents come before their children.
        quats: world rotation of every bone from rest, unit wxyz, of continuous sign over time.
        positions: joints at every frame, world units.
        bones: bones of every vertex; 0 where the weight is 0.
        weights: skinning weights, non-negative with sum 1, in descending order.
        motion_rms: root mean square distance of the vertices from their mean positions over time, world units.
        rms: root mean square distance between skinned and given vertices over all frames, world units.
        max_distance: largest of these distances, world units.
    """

    rest_positions: Float[Tensor, "b 3"]
    parents: Int[Tensor, " b"]
    quats: Float[Tensor, "t b 4"]
    positions: Float[Tensor, "t b 3"]
    bones: Int[Tensor, "v 4"]
    weights: Float[Tensor, "v 4"]
    motion_rms: float
    rms: float = 0.0
    max_distance: float = 0.0

    @property
    def stretch(self) -> float:
        """Largest change of the length of a bone, from the joint of its parent to its own, relative to rest."""
        parents = self.parents[1:]
        rest = (self.rest_positions[1:] - self.rest_positions[parents]).norm(dim=-1)
        moved = (self.positions[:, 1:] - self.positions[:, parents]).norm(dim=-1)
        return float((moved / rest.clamp_min(1e-9) - 1).abs().max()) if len(parents) else 0.0

    @property
    def error(self) -> float:
        """Residual relative to the motion: 0 is exact, 1 is as bad as no motion."""
        return self.rms / self.motion_rms if self.motion_rms > 0 else 0.0


def fit_rig(vertices: Float[Tensor, "v 3"], offsets: Float[Tensor, "t v 3"], error: float, max_bones: int) -> Rig:
    """Fit a rig with as few bones as possible to a motion; vertices at equal positions get equal weights.

    Args:
        vertices: at rest, world units.
        offsets: added to them at every frame, world units; vertices at equal positions move alike.
        error: target residual (`Rig.error`); bones are added until it is reached.
        max_bones: maximum number of bones; the rig is returned even if it misses the target with this number.

    Raises:
        BadInput: no vertices, no frames, or numbers that are not finite.
    """
    if 0 in offsets.shape or not (vertices.isfinite().all() and offsets.isfinite().all()):
        raise BadInput(
            f"a rig needs vertices, frames and finite numbers; given offsets of shape {tuple(offsets.shape)}: "
            "extract the mesh again"
        )
    given, origin = vertices.double().cpu().numpy(), vertices.double().cpu().numpy().mean(0)
    motion = offsets.double().cpu().numpy()
    _, firsts, copies = np.unique(given, axis=0, return_index=True, return_inverse=True)
    rest, moved = given[firsts] - origin, np.ascontiguousarray(motion[:, firsts].swapaxes(0, 1))
    motion_rms = float(np.sqrt(np.square(motion - motion.mean(0)).sum(-1).mean()))
    goal = max(error * motion_rms, EXACT * float(np.ptp(rest, axis=0).max()))
    maps, weights = _fit_fewest_bones(rest, moved, goal, max_bones)
    order, parents, joints = _skeleton(rest, weights)
    maps = maps[order]
    weights = _fit_weights(rest, moved, maps, _worth(goal, moved))
    maps, weights, joints = _articulated(rest, moved, goal, maps, weights, parents, joints)
    rotations = maps[..., :3] + np.eye(3)
    positions = (rotations @ joints[:, None, :, None])[..., 0] + maps[..., 3]
    bones, bone_weights = _largest_weights(weights[copies.ravel()])
    rig = Rig(
        torch.from_numpy(joints + origin).to(vertices),
        torch.from_numpy(parents),
        torch.from_numpy(continuous_quats(rotations)).to(vertices),
        torch.from_numpy(positions.swapaxes(0, 1) + origin).to(vertices),
        torch.from_numpy(bones),
        torch.from_numpy(bone_weights).to(vertices),
        motion_rms=motion_rms,
    )
    distances = (rig_offsets(rig, vertices.double()) - offsets.double()).norm(dim=-1)
    return replace(rig, rms=float(distances.square().mean().sqrt()), max_distance=float(distances.max()))


def rig_offsets(rig: Rig, vertices: Float[Tensor, "v 3"]) -> Float[Tensor, "t v 3"]:
    """Evaluate a rig: return the offsets of vertices from rest at every frame, world units."""
    rotations, rest, positions, weights = (
        x.to(vertices) for x in (quat_to_rotmat(rig.quats), rig.rest_positions, rig.positions, rig.weights)
    )
    linear = rotations - torch.eye(3).to(vertices)
    shifts = positions - rest - (linear @ rest[..., None])[..., 0]
    maps = torch.cat((linear.mT, shifts[:, :, None]), 2).flatten(1, 2)  # t b*4 3: homogeneous rows to displacements
    dense_weights = vertices.new_zeros(len(vertices), len(rest)).scatter_add_(1, rig.bones, weights)
    homogeneous = torch.cat((vertices, torch.ones_like(vertices[:, :1])), 1)
    return (dense_weights[..., None] * homogeneous[:, None]).flatten(1) @ maps


def _fit_fewest_bones(rest: Array, moved: Array, goal: float, max_bones: int) -> tuple[Array, Array]:
    """Add bones until the residual reaches the goal or their number the maximum; return bones and weights.

    The number of bones is searched on a sample of the vertices.
    """
    step = -(-len(rest) // SAMPLE)
    sample_rest, sample_moved = rest[::step], moved[::step]
    clusters, count = np.zeros(len(sample_rest), np.int64), 1
    while True:
        sample_maps, clusters = _cluster(sample_rest, sample_moved, clusters)
        sample_maps, sample_weights = _alternate(sample_rest, sample_moved, sample_maps, goal)
        last = count >= min(max_bones, len(sample_rest))
        if last or _rms(sample_rest, sample_moved, sample_maps, sample_weights) <= goal:
            maps, weights = _alternate(rest, moved, sample_maps, goal)
            if last or _rms(rest, moved, maps, weights) <= goal:
                return maps, weights
        count = min(max_bones, max(count + 1, round(GROWTH * count)))
        clusters = _split(sample_rest, sample_moved, sample_maps, sample_weights, clusters, count)


def _articulated(
    rest: Array, moved: Array, goal: float, maps: Array, weights: Array, parents: NDArray[np.int64], joints: Array
) -> tuple[Array, Array, Array]:
    """Let the bones keep their lengths, if the motion is then followed almost as well.

    Returns:
        Motions of the bones, weights, and joints at rest; those given if the motion tears the skeleton.
    """
    step = -(-len(rest) // SAMPLE)
    sample_rest, sample_moved, sample_weights = rest[::step], moved[::step], weights[::step]
    rotations = maps[..., :3] + np.eye(3)
    skeleton = Articulation(parents, joints, rotations, rotations[0] @ joints[0] + maps[0, :, :, 3])
    for _ in range(ARTICULATIONS):
        skeleton = fit_joints(skeleton, sample_rest, sample_moved, sample_weights, joints)
        skeleton = fit_rotations(skeleton, sample_rest, sample_moved, sample_weights)
        sample_weights = _fit_weights(sample_rest, sample_moved, skeleton.maps(), _worth(goal, moved))
    new_maps = skeleton.maps()
    new_weights = _fit_weights(rest, moved, new_maps, _worth(goal, moved))
    if _rms(rest, moved, new_maps, new_weights) > LOOSEST * max(goal, _rms(rest, moved, maps, weights)):
        return maps, weights, joints
    return new_maps, new_weights, skeleton.joints


def _worth(goal: float, moved: Array) -> float:
    """Return the decrease of the squared residual, summed over time, for which a vertex gets a further bone."""
    return float(moved.shape[1] * (WORTH * goal) ** 2)


def _cluster(rest: Array, moved: Array, clusters: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Alternate between fitting a rigid motion per cluster and assigning vertices; drop empty clusters."""
    for _ in range(CLUSTERING):
        members = np.eye(clusters.max() + 1)[clusters]
        maps = rigid_maps(rest, moved, members[:, members.any(0)])
        clusters = _squared_distances(rest, moved, maps).argmin(1)
    kept, clusters = np.unique(clusters, return_inverse=True)
    return maps[kept], clusters


def _split(
    rest: Array, moved: Array, maps: Array, weights: Array, clusters: NDArray[np.int64], wanted: int
) -> NDArray[np.int64]:
    """Split the clusters of largest residual: the worst vertex and those around it form a new cluster."""
    residuals = np.square(moved - _skinned(rest, maps, weights)).sum((1, 2))
    clusters = clusters.copy()
    totals = np.bincount(clusters, residuals)
    count = len(totals)
    for cluster in np.argsort(-totals, kind="stable")[: wanted - count]:
        members = np.flatnonzero(clusters == cluster)
        worst = members[residuals[members].argmax()]
        near = np.square(rest[members] - rest[worst]).sum(1).argsort(kind="stable")
        clusters[members[near[: max(1, round(SPLIT * len(members)))]]] = count
        count += 1
    return clusters


def _alternate(rest: Array, moved: Array, maps: Array, goal: float) -> tuple[Array, Array]:
    """Optimize weights and bones in alternation until the goal or convergence; drop bones without vertices."""
    weights, previous = _fit_weights(rest, moved, maps), np.inf
    for _ in range(ROUNDS):
        rms = _rms(rest, moved, maps, weights)
        if rms <= goal or rms > (1 - CONVERGED) * previous:
            break
        previous = rms
        maps = _fit_bones(rest, moved, maps, weights)
        maps = maps[np.square(weights).sum(0) > 0]
        weights = _fit_weights(rest, moved, maps)
    return maps, weights


def _fit_bones(rest: Array, moved: Array, maps: Array, weights: Array) -> Array:
    """Fit the rigid motion of one bone after the other, with the other bones and all weights fixed."""
    maps, residual = maps.copy(), moved - _skinned(rest, maps, weights)
    for bone, column in enumerate(weights.T):
        (members,) = np.nonzero(column)
        if len(members) == 0:
            continue
        weight = column[members, None, None]
        target = residual[members] / weight + _displaced(rest[members], maps[bone])
        maps[bone] = rigid_maps(rest[members], target, np.square(weight[..., 0]))[0]
        residual[members] = weight * (target - _displaced(rest[members], maps[bone]))
    return maps


def rigid_maps(rest: Array, moved: Array, weights: Array) -> Array:
    """Fit rigid motions to weighted vertices (Procrustes); return displacement matrices "k t 3 4"."""
    weights = weights / weights.sum(0)
    centers, flat = weights.T @ rest, moved.reshape(len(moved), -1)
    drift = (weights.T @ flat).reshape(len(centers), -1, 3)
    arms = (weights[..., None] * (rest[:, None] - centers)).reshape(len(rest), -1)  # n k*3
    spread = (arms.T @ rest).reshape(len(centers), 3, 3)
    cross = (arms.T @ flat).reshape(len(centers), 3, -1, 3).swapaxes(1, 2) + spread[:, None]
    cross += (STIFF * np.trace(spread, axis1=1, axis2=2)[:, None, None] * np.eye(3))[:, None]
    left, _, right = np.linalg.svd(cross)
    left[..., 2] *= np.sign(np.linalg.det(left) * np.linalg.det(right))[..., None]
    rotations = (left @ right).swapaxes(-1, -2)
    linear = rotations - np.eye(3)
    return np.concatenate((linear, (drift - (linear @ centers[:, None, :, None])[..., 0])[..., None]), -1)


def _squared_distances(rest: Array, moved: Array, maps: Array) -> Array:
    """Return squared distances "n k" to the motion of every single bone, up to a constant per vertex."""
    own = np.einsum("ktac,ktad->cdk", maps, maps).reshape(16, -1)
    return _outer_products(rest) @ own - 2 * _inner_products(rest, moved, maps)


def _inner_products(rest: Array, moved: Array, maps: Array) -> Array:
    """Return inner products "n k" of every bone's displacements with the given ones."""
    bones, frames = maps.shape[:2]
    columns = maps.transpose(1, 2, 0, 3).reshape(3 * frames, 4 * bones)
    products = (moved.reshape(len(moved), -1) @ columns).reshape(len(rest), bones, 4)
    return np.einsum("nkc,nc->nk", products, _homogeneous(rest))


def _homogeneous(rest: Array) -> Array:
    return np.concatenate((rest, np.ones((len(rest), 1))), 1)


def _outer_products(rest: Array) -> Array:
    """Return outer products "n 16" of the homogeneous coordinates."""
    points = _homogeneous(rest)
    return (points[:, :, None] * points[:, None]).reshape(len(rest), 16)


def _fit_weights(rest: Array, moved: Array, maps: Array, worth: float = 0.0) -> Array:
    """Fit convex weights "n k" with at most four bones per vertex, added greedily.

    Args:
        rest: vertices "n 3".
        moved: their displacements "n t 3".
        maps: displacement matrices of the bones "k t 3 4".
        worth: least decrease of the squared residual, summed over time, for which a vertex gets a further bone.
    """
    bones = len(maps)
    pairs = np.einsum("ktac,ltad->cdkl", maps, maps, optimize=True).reshape(16, bones * bones)
    parts = []
    for start in range(0, len(rest), CHUNK):
        part = slice(start, start + CHUNK)
        gram = (_outer_products(rest[part]) @ pairs).reshape(-1, bones, bones)
        parts.append(_greedy_weights(gram, _inner_products(rest[part], moved[part], maps), worth))
    return np.concatenate(parts)


def _greedy_weights(gram: Array, given: Array, worth: float) -> Array:
    """Select up to four bones per vertex greedily and solve for their weights.

    Starts with the best bone; each further bone is the one that decreases the residual most on the line towards it, and
    then all selected weights are solved anew.

    Args:
        gram: inner products "n k k" of the bones' displacements.
        given: their inner products "n k" with the given displacements.
        worth: decrease of the residual below which a vertex gets no further bone.
    """
    rows = np.arange(len(gram))[:, None]
    own = np.einsum("nkk->nk", gram)
    selected = (own - 2 * given).argmin(1)[:, None]
    shares = np.ones(selected.shape)
    for _ in range(1, min(INFLUENCES, gram.shape[1])):
        blend_bone = (gram[rows, selected] * shares[..., None]).sum(1)  # inner product of the blend with every bone
        blend_blend = (blend_bone[rows, selected] * shares).sum(1, keepdims=True)
        slope = blend_blend - blend_bone - ((given[rows, selected] * shares).sum(1, keepdims=True) - given)
        length = own - 2 * blend_bone + blend_blend
        gain = np.square(slope.clip(0)) / length.clip(np.finfo(float).tiny)
        gain[rows, selected] = -1
        selected = np.concatenate((selected, gain.argmax(1)[:, None]), 1)
        inner, outer = gram[rows[..., None], selected[:, :, None], selected[:, None]], given[rows, selected]
        before, after = np.pad(shares, ((0, 0), (0, 1))), _convex_weights(inner, outer)
        helps = _cost(inner, outer, before) - _cost(inner, outer, after) > worth
        shares = np.where(helps[:, None], after, before)
    weights = np.zeros(given.shape)
    weights[rows, selected] = shares
    return weights


def _cost(gram: Array, given: Array, weights: Array) -> Array:
    """Return the squared residuals of weights, up to a constant per vertex."""
    return np.einsum("na,nab,nb->n", weights, gram, weights) - 2 * np.asarray((weights * given).sum(1))


def _convex_weights(gram: Array, given: Array) -> Array:
    """Minimize w G w - 2 w g over convex weights of up to four bones.

    The minimum over weights of sum 1 is the solution if none is negative; else all subsets of the bones are tried.
    """
    count = gram.shape[1]
    weights = _affine_weights(gram, given)
    (remaining,) = np.nonzero((weights < 0).any(1))
    gram, given = gram[remaining], given[remaining]
    single = np.einsum("naa->na", gram) - 2 * given
    best_cost, best = single.min(1), np.eye(count)[single.argmin(1)]
    for number in range(2, count):
        for subset in map(list, combinations(range(count), number)):
            inner, outer = gram[:, np.array(subset)[:, None], subset], given[:, subset]
            candidate = _affine_weights(inner, outer)
            cost = _cost(inner, outer, candidate)
            better = (candidate >= 0).all(1) & (cost < best_cost)
            best_cost[better] = cost[better]
            best[better] = 0
            best[np.ix_(better, subset)] = candidate[better]
    weights[remaining] = best
    return weights / weights.sum(1, keepdims=True)


def _affine_weights(gram: Array, given: Array) -> Array:
    """Minimize w G w - 2 w g over weights of sum 1, which may be negative."""
    count = gram.shape[1]
    scale = np.trace(gram, axis1=1, axis2=2)[:, None, None] + np.finfo(float).tiny
    system = np.ones((len(gram), count + 1, count + 1))
    system[:, :-1, :-1] = gram / scale + STIFF * np.eye(count)
    system[:, -1, -1] = 0
    right = np.ones((len(gram), count + 1, 1))
    right[:, :-1] = given[..., None] / scale
    return np.asarray(np.linalg.solve(system, right)[:, :-1, 0])


def _displaced(rest: Array, maps: Array) -> Array:
    """Return the displacements "n t 3" of vertices by one bone."""
    return (_homogeneous(rest) @ maps.reshape(-1, 4).T).reshape(len(rest), -1, 3)


def _skinned(rest: Array, maps: Array, weights: Array) -> Array:
    """Return the displacements "n t 3" of vertices by linear blend skinning."""
    weighted = (weights[:, :, None] * _homogeneous(rest)[:, None]).reshape(len(rest), -1)
    return (weighted @ maps.transpose(0, 3, 1, 2).reshape(weighted.shape[1], -1)).reshape(len(rest), -1, 3)


def _rms(rest: Array, moved: Array, maps: Array, weights: Array) -> float:
    return float(np.sqrt(np.square(moved - _skinned(rest, maps, weights)).sum(-1).mean()))


def _skeleton(rest: Array, weights: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Return an order of the bones with parents first, their parents in this order, and their joints.

    Bones that share vertices are connected, near ones first; the joint is the weighted center of the shared vertices.
    The root is the bone with the largest total weight.
    """
    totals = weights.sum(0)
    centers = weights.T @ rest / totals[:, None]
    shared = weights.T @ weights
    distances = np.linalg.norm(centers[:, None] - centers, axis=-1)
    tree = minimum_spanning_tree((distances + APART) / (shared + APART))
    order, predecessors = breadth_first_order(tree, int(totals.argmax()), directed=False)
    joints = centers[order]
    for number, bone in enumerate(order[1:], 1):
        both = weights[:, bone] * weights[:, predecessors[bone]]
        if both.any():
            joints[number] = both @ rest / both.sum()
    parents = np.concatenate(([-1], np.argsort(order)[predecessors[order[1:]]]))
    return order.astype(np.int64), parents, joints


def _largest_weights(weights: Array) -> tuple[NDArray[np.int64], Array]:
    """Return the four bones of largest weight of every vertex, and their weights: "v 4"."""
    padded = np.pad(weights, ((0, 0), (0, max(0, INFLUENCES - weights.shape[1]))))
    bones = np.argsort(-padded, axis=1, kind="stable")[:, :INFLUENCES]
    selected = np.take_along_axis(padded, bones, 1)
    return np.where(selected > 0, bones, 0), selected


def continuous_quats(rotations: Array) -> Array:
    """Return rotation matrices "k t 3 3" as quaternions "t k 4", wxyz, with w >= 0 first and then continuous signs."""
    bones, frames = rotations.shape[:2]
    xyzw = Rotation.from_matrix(rotations.swapaxes(0, 1).reshape(-1, 3, 3)).as_quat(canonical=True)
    quats = xyzw[:, [3, 0, 1, 2]].reshape(frames, bones, 4)
    flips = np.where((quats[1:] * quats[:-1]).sum(-1) < 0, -1.0, 1.0)
    quats[1:] *= np.cumprod(flips, 0)[..., None]
    return quats
