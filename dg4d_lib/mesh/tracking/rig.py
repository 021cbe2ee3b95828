"""A skeleton out of a motion: few bones, and for every vertex which of them it follows.

Smooth skinning decomposition with rigid bones (Le and Deng 2012), whose names here and there are: `rest` p, `moved` v,
bones B, `weights` w, at most four per vertex, convex. Vertices are first grouped by the rigid motions that they share;
then weights and motions of the bones are improved by turns, each exactly while the other stands still. Nothing is
drawn at random.
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

INFLUENCES = 4  # bones of a vertex: what every player supports
GROWTH = 1.4  # from one number of bones to the next that is tried
GROUPING = 4  # rounds of grouping after the groups were split
ROUNDS = 8  # of weights and bones by turns, at most
SETTLED = 0.01  # share of the residual below which a round's gain ends them
SAMPLE = 2000  # vertices on which numbers of bones are tried
SPLIT = 0.2  # share of its group's vertices that a new bone begins with: those around the worst one
STIFF = 1e-9  # how much rather a bone does not turn where its vertices do not say, against how far they lie apart
APART = 1e-6  # of a vertex, and of a world unit: bones that share nothing are joined last
EXACT = 1e-7  # of the mesh's size: float32 tells no more
CHUNK = 2048  # vertices whose weights are found at once, bounds the memory

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rig:
    """Bones and the vertices that follow them: linear-blend skinning.

    A bone b takes a point x at rest to R(quats[t, b]) (x - rest_positions[b]) + positions[t, b] at frame t; a vertex goes where its
    bones take it, by weight.

    Attributes:
        rest_positions: where the joints are at rest, world units.
        parents: of every bone, -1 for the root; a parent comes before its children.
        quats: how far every bone has turned from rest, in the world, wxyz, unit, without jumps of sign.
        positions: where every joint is, world units.
        bones: that a vertex follows; 0 where the weight is 0.
        weights: not negative, sum 1, the largest first.
        motion_rms: how much there is to follow: root mean square of the vertices' distances to their mean places.
        rms: distance between skin and given motion, root mean square over all vertices and frames, world units.
        max_distance: of these distances, world units.
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
    def error(self) -> float:
        """The part of the motion that the rig misses: 0 is exact, 1 is as bad as no motion."""
        return self.rms / self.motion_rms if self.motion_rms > 0 else 0.0


def fit_rig(vertices: Float[Tensor, "v 3"], offsets: Float[Tensor, "t v 3"], error: float, max_bones: int) -> Rig:
    """The smallest rig found that follows a motion; vertices at the same place get the same weights.

    Args:
        vertices: at rest, world units.
        offsets: what to add to them at every frame, world units; vertices at the same place move alike.
        error: part of the motion (`Rig.error`) that may be missed; bones are added until it is reached.
        max_bones: they are not added beyond this number, and the rig is returned as it is.

    Raises:
        BadInput: no vertices, no frames, or numbers that are not finite.
    """
    if 0 in offsets.shape or not (vertices.isfinite().all() and offsets.isfinite().all()):
        raise BadInput("a rig needs vertices, frames and finite numbers; check the mesh and its offsets")
    given, origin = vertices.double().cpu().numpy(), vertices.double().cpu().numpy().mean(0)
    motion = offsets.double().cpu().numpy()
    _, firsts, copies = np.unique(given, axis=0, return_index=True, return_inverse=True)
    rest, moved = given[firsts] - origin, np.ascontiguousarray(motion[:, firsts].swapaxes(0, 1))
    amount = float(np.sqrt(np.square(motion - motion.mean(0)).sum(-1).mean()))
    goal = max(error * amount, EXACT * float(np.ptp(rest, axis=0).max()))
    maps, weights = _fewest(rest, moved, goal, max_bones)
    order, parents, joints = _skeleton(rest, weights)
    turns = maps[order, :, :, :3] + np.eye(3)
    places = (turns @ joints[:, None, :, None])[..., 0] + maps[order, :, :, 3]
    bones, shares = _strongest(weights[:, order][copies.ravel()])
    rig = Rig(
        torch.from_numpy(joints + origin).to(vertices),
        torch.from_numpy(parents),
        torch.from_numpy(_quaternions(turns)).to(vertices),
        torch.from_numpy(places.swapaxes(0, 1) + origin).to(vertices),
        torch.from_numpy(bones),
        torch.from_numpy(shares).to(vertices),
        motion_rms=amount,
    )
    misses = (rig_offsets(rig, vertices.double()) - offsets.double()).norm(dim=-1)
    return replace(rig, rms=float(misses.square().mean().sqrt()), max_distance=float(misses.max()))


def rig_offsets(rig: Rig, vertices: Float[Tensor, "v 3"]) -> Float[Tensor, "t v 3"]:
    """What the rig adds to vertices at rest at every frame, world units."""
    turns, rest, places, weights = (
        x.to(vertices) for x in (quat_to_rotmat(rig.quats), rig.rest_positions, rig.positions, rig.weights)
    )
    moves = turns - torch.eye(3).to(vertices)
    shifts = places - rest - (moves @ rest[..., None])[..., 0]
    maps = torch.cat((moves.mT, shifts[:, :, None]), 2).flatten(1, 2)  # t b*4 3: homogeneous rows to displacements
    shares = vertices.new_zeros(len(vertices), len(rest)).scatter_add_(1, rig.bones, weights)
    ends = torch.cat((vertices, torch.ones_like(vertices[:, :1])), 1)
    return (shares[..., None] * ends[:, None]).flatten(1) @ maps


def _fewest(rest: Array, moved: Array, goal: float, most: int) -> tuple[Array, Array]:
    """Bones and weights for which the residual is at most the goal, or the most bones allowed.

    How many are needed is tried on a sample of the vertices.
    """
    step = -(-len(rest) // SAMPLE)
    some, sample = rest[::step], moved[::step]
    groups, wanted = np.zeros(len(some), np.int64), 1
    while True:
        rigid, groups = _grouped(some, sample, groups)
        rigid, weights = _skinned(some, sample, rigid, goal)
        last = wanted >= min(most, len(some))
        if last or _rms(some, sample, rigid, weights) <= goal:
            maps, weights_of_all = _skinned(rest, moved, rigid, goal)
            if last or _rms(rest, moved, maps, weights_of_all) <= goal:
                return maps, weights_of_all
        wanted = min(most, max(wanted + 1, round(GROWTH * wanted)))
        groups = _split(some, sample, rigid, weights, groups, wanted)


def _grouped(rest: Array, moved: Array, groups: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Vertices to the rigid motion that fits each best, and motions to their vertices, by turns. Empty groups go."""
    for _ in range(GROUPING):
        members = np.eye(groups.max() + 1)[groups]
        maps = _rigid(rest, moved, members[:, members.any(0)])
        groups = _misses(rest, moved, maps).argmin(1)
    kept, groups = np.unique(groups, return_inverse=True)
    return maps[kept], groups


def _split(
    rest: Array, moved: Array, maps: Array, weights: Array, groups: NDArray[np.int64], wanted: int
) -> NDArray[np.int64]:
    """More groups: the worst vertices of the worst groups take their surroundings with them."""
    miss = np.square(moved - _blended(rest, maps, weights)).sum((1, 2))
    groups = groups.copy()
    totals = np.bincount(groups, miss)
    count = len(totals)
    for group in np.argsort(-totals, kind="stable")[: wanted - count]:
        members = np.flatnonzero(groups == group)
        worst = members[miss[members].argmax()]
        near = np.square(rest[members] - rest[worst]).sum(1).argsort(kind="stable")
        groups[members[near[: max(1, round(SPLIT * len(members)))]]] = count
        count += 1
    return groups


def _skinned(rest: Array, moved: Array, maps: Array, goal: float) -> tuple[Array, Array]:
    """Bones and weights improved by turns, until the goal or standstill. Bones that nobody follows go."""
    weights, before = _weights(rest, moved, maps), np.inf
    for _ in range(ROUNDS):
        now = _rms(rest, moved, maps, weights)
        if now <= goal or now > (1 - SETTLED) * before:
            break
        before = now
        maps = _bones(rest, moved, maps, weights)
        maps = maps[np.square(weights).sum(0) > 0]
        weights = _weights(rest, moved, maps)
    return maps, weights


def _bones(rest: Array, moved: Array, maps: Array, weights: Array) -> Array:
    """Every bone's best rigid motion in turn, with the others and all weights as they are."""
    maps, left = maps.copy(), moved - _blended(rest, maps, weights)
    for bone, column in enumerate(weights.T):
        (members,) = np.nonzero(column)
        if len(members) == 0:
            continue
        share = column[members, None, None]
        target = left[members] / share + _displaced(rest[members], maps[bone])
        maps[bone] = _rigid(rest[members], target, np.square(share[..., 0]))[0]
        left[members] = share * (target - _displaced(rest[members], maps[bone]))
    return maps


def _rigid(rest: Array, moved: Array, shares: Array) -> Array:
    """The rigid motions that fit weighted vertices best (Procrustes), as matrices of displacements "k t 3 4"."""
    shares = shares / shares.sum(0)
    centers, flat = shares.T @ rest, moved.reshape(len(moved), -1)
    drift = (shares.T @ flat).reshape(len(centers), -1, 3)
    arms = (shares[..., None] * (rest[:, None] - centers)).reshape(len(rest), -1)  # n k*3
    spread = (arms.T @ rest).reshape(len(centers), 3, 3)
    cross = (arms.T @ flat).reshape(len(centers), 3, -1, 3).swapaxes(1, 2) + spread[:, None]
    cross += (STIFF * np.trace(spread, axis1=1, axis2=2)[:, None, None] * np.eye(3))[:, None]
    left, _, right = np.linalg.svd(cross)
    left[..., 2] *= np.sign(np.linalg.det(left) * np.linalg.det(right))[..., None]
    turns = (left @ right).swapaxes(-1, -2)
    turned = turns - np.eye(3)
    return np.concatenate((turned, (drift - (turned @ centers[:, None, :, None])[..., 0])[..., None]), -1)


def _misses(rest: Array, moved: Array, maps: Array) -> Array:
    """Squared distances "n k" to what every bone alone would do, up to a constant of each vertex."""
    own = np.einsum("ktac,ktad->cdk", maps, maps).reshape(16, -1)
    return _squares(rest) @ own - 2 * _along(rest, moved, maps)


def _along(rest: Array, moved: Array, maps: Array) -> Array:
    """Products "n k" of the displacements of every bone with those given."""
    bones, frames = maps.shape[:2]
    columns = maps.transpose(1, 2, 0, 3).reshape(3 * frames, 4 * bones)
    products = (moved.reshape(len(moved), -1) @ columns).reshape(len(rest), bones, 4)
    return np.einsum("nkc,nc->nk", products, _ends(rest))


def _ends(rest: Array) -> Array:
    """Homogeneous coordinates."""
    return np.concatenate((rest, np.ones((len(rest), 1))), 1)


def _squares(rest: Array) -> Array:
    """Products "n 16" of homogeneous coordinates with each other."""
    ends = _ends(rest)
    return (ends[:, :, None] * ends[:, None]).reshape(len(rest), 16)


def _weights(rest: Array, moved: Array, maps: Array) -> Array:
    """The best convex weights "n k" with at most four bones a vertex, found bone by bone."""
    bones = len(maps)
    pairs = np.einsum("ktac,ltad->cdkl", maps, maps, optimize=True).reshape(16, bones * bones)
    parts = []
    for start in range(0, len(rest), CHUNK):
        part = slice(start, start + CHUNK)
        gram = (_squares(rest[part]) @ pairs).reshape(-1, bones, bones)
        parts.append(_chosen(gram, _along(rest[part], moved[part], maps)))
    return np.concatenate(parts)


def _chosen(gram: Array, given: Array) -> Array:
    """Weights out of products of the bones' displacements with each other, and with those given.

    It begins with the best bone, takes the one that helps most on the straight way to it, and weighs all taken anew.
    """
    rows = np.arange(len(gram))[:, None]
    own = np.einsum("nkk->nk", gram)
    chosen = (own - 2 * given).argmin(1)[:, None]
    shares = np.ones(chosen.shape)
    for _ in range(1, min(INFLUENCES, gram.shape[1])):
        there = (gram[rows, chosen] * shares[..., None]).sum(1)  # product of the blend with every bone
        itself = (there[rows, chosen] * shares).sum(1, keepdims=True)
        slope = itself - there - ((given[rows, chosen] * shares).sum(1, keepdims=True) - given)
        length = own - 2 * there + itself
        gain = np.square(slope.clip(0)) / length.clip(np.finfo(float).tiny)
        gain[rows, chosen] = -1
        chosen = np.concatenate((chosen, gain.argmax(1)[:, None]), 1)
        shares = _convex(gram[rows[..., None], chosen[:, :, None], chosen[:, None]], given[rows, chosen])
    weights = np.zeros(given.shape)
    weights[rows, chosen] = shares
    return weights


def _convex(gram: Array, given: Array) -> Array:
    """The convex weights w with the least w G w - 2 w g, for up to four bones.

    Where those that only sum to 1 are not negative, they are it; elsewhere every choice of fewer bones is tried.
    """
    count = gram.shape[1]
    weights = _balanced(gram, given)
    (left,) = np.nonzero((weights < 0).any(1))
    gram, given = gram[left], given[left]
    alone = np.einsum("naa->na", gram) - 2 * given
    best, found = alone.min(1), np.eye(count)[alone.argmin(1)]
    for number in range(2, count):
        for taken in map(list, combinations(range(count), number)):
            inner, outer = gram[:, np.array(taken)[:, None], taken], given[:, taken]
            some = _balanced(inner, outer)
            cost = np.einsum("na,nab,nb->n", some, inner, some) - 2 * (some * outer).sum(1)
            better = (some >= 0).all(1) & (cost < best)
            best[better] = cost[better]
            found[better] = 0
            found[np.ix_(better, taken)] = some[better]
    weights[left] = found
    return weights / weights.sum(1, keepdims=True)


def _balanced(gram: Array, given: Array) -> Array:
    """The weights w with the least w G w - 2 w g that sum to 1; they may be negative."""
    count = gram.shape[1]
    scale = np.trace(gram, axis1=1, axis2=2)[:, None, None] + np.finfo(float).tiny
    system = np.ones((len(gram), count + 1, count + 1))
    system[:, :-1, :-1] = gram / scale + STIFF * np.eye(count)
    system[:, -1, -1] = 0
    right = np.ones((len(gram), count + 1, 1))
    right[:, :-1] = given[..., None] / scale
    return np.asarray(np.linalg.solve(system, right)[:, :-1, 0])


def _displaced(rest: Array, maps: Array) -> Array:
    """What one bone adds to vertices, "n t 3"."""
    return (_ends(rest) @ maps.reshape(-1, 4).T).reshape(len(rest), -1, 3)


def _blended(rest: Array, maps: Array, weights: Array) -> Array:
    """What the skin adds to vertices, "n t 3"."""
    carried = (weights[:, :, None] * _ends(rest)[:, None]).reshape(len(rest), -1)
    return (carried @ maps.transpose(0, 3, 1, 2).reshape(carried.shape[1], -1)).reshape(len(rest), -1, 3)


def _rms(rest: Array, moved: Array, maps: Array, weights: Array) -> float:
    return float(np.sqrt(np.square(moved - _blended(rest, maps, weights)).sum(-1).mean()))


def _skeleton(rest: Array, weights: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Bones in an order in which parents come first, their parents in this order, and where their joints are.

    Bones that share vertices are joined, the near rather than the far, at the middle of what they share. The root is
    the bone that carries most.
    """
    carried = weights.sum(0)
    centers = weights.T @ rest / carried[:, None]
    shared = weights.T @ weights
    apart = np.linalg.norm(centers[:, None] - centers, axis=-1)
    tree = minimum_spanning_tree((apart + APART) / (shared + APART))
    order, before = breadth_first_order(tree, int(carried.argmax()), directed=False)
    joints = centers[order]
    for number, bone in enumerate(order[1:], 1):
        both = weights[:, bone] * weights[:, before[bone]]
        if both.any():
            joints[number] = both @ rest / both.sum()
    parents = np.concatenate(([-1], np.argsort(order)[before[order[1:]]]))
    return order.astype(np.int64), parents, joints


def _strongest(weights: Array) -> tuple[NDArray[np.int64], Array]:
    """The bones of every vertex, and their weights: "v 4"."""
    padded = np.pad(weights, ((0, 0), (0, max(0, INFLUENCES - weights.shape[1]))))
    bones = np.argsort(-padded, axis=1, kind="stable")[:, :INFLUENCES]
    shares = np.take_along_axis(padded, bones, 1)
    return np.where(shares > 0, bones, 0), shares


def _quaternions(turns: Array) -> Array:
    """Of rotation matrices "k t 3 3": wxyz, "t k 4", the first with w >= 0, the next on the near side of the last."""
    bones, frames = turns.shape[:2]
    xyzw = Rotation.from_matrix(turns.swapaxes(0, 1).reshape(-1, 3, 3)).as_quat(canonical=True)
    quats = xyzw[:, [3, 0, 1, 2]].reshape(frames, bones, 4)
    flips = np.where((quats[1:] * quats[:-1]).sum(-1) < 0, -1.0, 1.0)
    quats[1:] *= np.cumprod(flips, 0)[..., None]
    return quats
