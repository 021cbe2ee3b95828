"""Few rigid parts that explain a motion, such as a box and its lid.

Neighboring clusters of points are merged as long as one rigid motion fits both well enough: agglomerative clustering
(Ward 1963) by the error of rigid fits (Kabsch 1976), from the control nodes on.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn import functional

from dg4d_lib.fitting.node_motion import NodeMotion
from dg4d_lib.geometry.quaternion import quat_multiply, quat_to_rotmat, rotate
from dg4d_lib.mesh.models.control_graph import ControlGraph

UNEXPLAINED = 0.15  # largest residual of rigid parts relative to the displacements, root mean square
NEARLY_ONE = 0.9  # share of the weights of a piece of the surface that one part has, above which it has all


@dataclass(frozen=True)
class RigidMotion:
    """Rigid motions of parts.

    Attributes:
        parts: part of every control node.
        centers: of the parts at rest, world units.
        quats: rotations of the parts about their centers at every frame, wxyz, unit.
        places: centers of the parts at every frame.
    """

    parts: Int[Tensor, " m"]
    centers: Float[Tensor, "k 3"]
    quats: Float[Tensor, "t k 4"]
    places: Float[Tensor, "t k 3"]

    def at(self, frames: slice) -> "RigidMotion":
        """Return the motion of some frames."""
        return RigidMotion(self.parts, self.centers, self.quats[frames], self.places[frames])

    def changed(self, change: Float[Tensor, "t k 6"]) -> "RigidMotion":
        """Return the motion after further shifts, world units, and turns, along their axes of about their angles."""
        turns = torch.cat([torch.ones_like(change[..., :1]), 0.5 * change[..., 3:]], -1)
        quats = quat_multiply(functional.normalize(turns, dim=-1), self.quats)
        return RigidMotion(self.parts, self.centers, quats, self.places + change[..., :3])

    def of_nodes(self, graph: ControlGraph) -> NodeMotion:
        """Return the motion of the nodes that the parts consist of."""
        quats = self.quats[:, self.parts]
        spans = graph.nodes - self.centers[self.parts]
        moved = rotate(quat_to_rotmat(quats), spans) + self.places[:, self.parts]
        still = quats.new_tensor([1.0, 0, 0, 0]).repeat(len(quats), 1)
        return NodeMotion(quats, moved - graph.nodes, still, torch.zeros_like(still[:, 1:]))


def find_rigid_parts(
    motion: NodeMotion, graph: ControlGraph, points: Float[Tensor, "v 3"], most: int
) -> RigidMotion | None:
    """Return the fewest rigid parts whose motions approximate a motion well.

    Args:
        motion: of the nodes.
        graph: with the weights of the points.
        points: at rest, world units.
        most: number of parts.

    Returns:
        Parts with the rigid motions that are nearest to the motion; None if more than `most` would be needed.
    """
    with torch.no_grad():
        moved = torch.cat([motion.nodes(graph), motion.points(points, graph)], 1).double().numpy(force=True)
    strongest = graph.indices.gather(1, graph.weights.argmax(1, keepdim=True))[:, 0]
    owners = torch.cat([torch.arange(len(graph.nodes)).to(strongest), strongest]).numpy(force=True)
    rest = torch.cat([graph.nodes, points]).double().numpy(force=True)
    bound = UNEXPLAINED**2 * np.square(moved - rest).sum()
    parts = _merge_clusters(_Moments.of(rest, moved, owners), graph.edges.numpy(force=True), float(bound))
    if int(parts.max()) >= most:
        return None
    return _fit_rigid_motion(parts, _Moments.of(rest, moved, parts[owners]), graph)


def two_rigid_parts(graph: ControlGraph, moved: Float[Tensor, "t v 3"]) -> RigidMotion | None:
    """Return the two connected parts whose rigid motions are nearest to a motion of the points.

    Args:
        graph: with the weights of the points.
        moved: points at every frame, world units; the first one is at rest.

    Returns:
        The part that moves less is number 0. None if the graph is not connected, or a node moves no point.
    """
    there = moved.double().numpy(force=True)
    owners = graph.indices.gather(1, graph.weights.argmax(1, keepdim=True))[:, 0].numpy(force=True)
    if len(np.unique(owners)) < len(graph.nodes):
        return None
    moments = _Moments.of(there[0], there, owners)
    parts = _merge_clusters(moments, graph.edges.numpy(force=True), math.inf, fewest=2)
    if int(parts.max()) != 1:
        return None
    moves = np.square(there - there[0]).sum(-1).mean(0)
    if moves[parts[owners] == 0].mean() > moves[parts[owners] == 1].mean():
        parts = 1 - parts
    return _fit_rigid_motion(parts, _Moments.of(there[0], there, parts[owners]), graph)


def of_one_part(graph: ControlGraph, parts: Int[Tensor, " m"], owners: Int[Tensor, " v"]) -> ControlGraph:
    """Bind every point to a single rigid part; return the graph with these weights.

    Args:
        graph: nodes.
        parts: of the nodes, from 0 on.
        owners: part of every point.
    """
    first = functional.one_hot(parts).argmax(0)[owners]  # any node of a part moves as the part does
    indices = first[:, None].expand(-1, graph.weights.shape[1])
    weights = functional.one_hot(torch.zeros_like(owners), graph.weights.shape[1]).to(graph.weights)
    return replace(graph, indices=indices, weights=weights)


def keep_pieces_rigid(graph: ControlGraph, parts: Int[Tensor, " m"], pieces: Int[Tensor, " v"]) -> ControlGraph:
    """Bind surface pieces that nearly belong to one rigid part to this part; return the graph with these weights.

    They do not bend where parts meet, as a lid does not at its hinge. Pieces of several parts bend as before.

    Args:
        graph: weights of the nodes of several parts.
        parts: of the nodes, from 0 on.
        pieces: connected piece of the surface that every point belongs to, from 0 on.
    """
    shares = (functional.one_hot(parts)[graph.indices] * graph.weights[..., None]).sum(1)
    sums = shares.new_zeros(int(pieces.max()) + 1, shares.shape[1]).index_add_(0, pieces, shares)
    largest, owner = (sums / sums.sum(1, keepdim=True)).max(1)
    rigid = (largest > NEARLY_ONE)[pieces, None]
    alone = of_one_part(graph, parts, owner[pieces])
    return replace(
        graph,
        indices=torch.where(rigid, alone.indices, graph.indices),
        weights=torch.where(rigid, alone.weights, graph.weights),
    )


@dataclass(frozen=True)
class _Moments:
    """Sums over the points of clusters, from which their best rigid motions follow.

    Attributes:
        count: of points.
        rest: of the points at rest.
        moved: of the moved points.
        cross: of outer products of points at rest and moved.
        squares: of squared norms, at rest and moved.
    """

    count: Float64[np.ndarray, " c"]
    rest: Float64[np.ndarray, "c 3"]
    moved: Float64[np.ndarray, "c t 3"]
    cross: Float64[np.ndarray, "c t 3 3"]
    squares: Float64[np.ndarray, "c t"]

    @classmethod
    def of(
        cls, rest: Float64[np.ndarray, "n 3"], moved: Float64[np.ndarray, "t n 3"], clusters: Int[np.ndarray, " n"]
    ) -> "_Moments":
        """Sum over the points of every cluster."""
        rows = moved.swapaxes(0, 1)
        products = rest[:, None, :, None] * rows[:, :, None]
        squares = np.square(rest).sum(-1)[:, None] + np.square(rows).sum(-1)
        terms = (np.ones(len(rest)), rest, rows, products, squares)
        sums = [np.zeros((int(clusters.max()) + 1, *term.shape[1:])) for term in terms]
        for total, term in zip(sums, terms, strict=True):
            np.add.at(total, clusters, term)
        return cls(*sums)

    def pair_sums(self, first: Int[np.ndarray, " p"], second: Int[np.ndarray, " p"]) -> "_Moments":
        """Return the sums of pairs of clusters."""
        return _Moments(*(values[first] + values[second] for values in vars(self).values()))

    def errors(self) -> Float64[np.ndarray, " c"]:
        """Return the squared distances of the points from their best rigid motions, summed over points and frames."""
        covariance, spread = self._centered()
        singular = np.linalg.svd(covariance, compute_uv=False)
        singular[..., 2] *= np.sign(np.linalg.det(covariance))
        errors: Float64[np.ndarray, " c"] = (spread - 2 * singular.sum(-1)).clip(0).sum(-1)
        return errors

    def rotations(self) -> Float64[np.ndarray, "c t 3 3"]:
        """Return the best rotations (Kabsch 1976)."""
        u, _, vt = np.linalg.svd(self._centered()[0])
        flips = np.sign(np.linalg.det(u) * np.linalg.det(vt))
        vt[..., 2, :] *= flips[..., None]
        rotations: Float64[np.ndarray, "c t 3 3"] = np.swapaxes(u @ vt, -1, -2)
        return rotations

    def _centered(self) -> tuple[Float64[np.ndarray, "c t 3 3"], Float64[np.ndarray, "c t"]]:
        """Return covariances of points at rest and moved, and sums of squared distances from the means."""
        outer = self.rest[:, None, :, None] * self.moved[:, :, None]
        norms = np.square(self.rest).sum(-1)[:, None] + np.square(self.moved).sum(-1)
        return self.cross - outer / self.count[:, None, None, None], self.squares - norms / self.count[:, None]


def _fit_rigid_motion(parts: Int[np.ndarray, " m"], moments: _Moments, graph: ControlGraph) -> RigidMotion:
    """Return the rigid motion of every part that fits its nodes best."""
    turns = Rotation.from_matrix(moments.rotations().reshape(-1, 3, 3)).as_quat(scalar_first=True)
    quats = turns.reshape(len(moments.count), -1, 4).swapaxes(0, 1)
    places = moments.moved / moments.count[:, None, None]
    return RigidMotion(
        torch.from_numpy(parts).to(graph.indices),
        torch.from_numpy(moments.rest / moments.count[:, None]).to(graph.nodes),
        torch.from_numpy(quats.copy()).to(graph.nodes),
        torch.from_numpy(places.swapaxes(0, 1).copy()).to(graph.nodes),
    )


def _merge_clusters(
    moments: _Moments, edges: Int[np.ndarray, "e 2"], bound: float, fewest: int = 1
) -> Int[np.ndarray, " m"]:
    """Merge neighboring clusters while the error of all stays below a bound; return the cluster of every node."""
    values = _Moments(*(array.copy() for array in vars(moments).values()))
    errors = values.errors()
    clusters = np.arange(len(errors))
    costs: dict[tuple[int, int], float] = {}

    def compare(pairs: list[tuple[int, int]]) -> None:
        if pairs:
            first, second = np.array(pairs).T
            costs.update(
                zip(pairs, values.pair_sums(first, second).errors() - errors[first] - errors[second], strict=True)
            )

    compare(sorted({(min(pair), max(pair)) for pair in edges.tolist()}))
    total, left = float(errors.sum()), len(errors)
    while costs and left > fewest:
        kept, gone = pair = min(costs, key=lambda one: (costs[one], one))
        total += costs[pair]
        if total > bound:
            break
        for array in vars(values).values():
            array[kept] += array[gone]
        errors[kept] += errors[gone] + costs[pair]
        clusters[clusters == gone] = kept
        left -= 1
        ends = {node for other in costs if kept in other or gone in other for node in other} - {kept, gone}
        costs = {other: cost for other, cost in costs.items() if kept not in other and gone not in other}
        compare(sorted((min(kept, node), max(kept, node)) for node in ends))
    found: Int[np.ndarray, " m"] = np.unique(clusters, return_inverse=True)[1]
    return found
