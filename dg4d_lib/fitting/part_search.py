"""Search of parts that tracking has lost: they are turned about their joints in many ways, and renders are compared.

Parts are sets of control nodes of all sizes: branches, which are the pieces of the graph beyond a distance from its
middle, and clusters by normalized cuts (Shi and Malik 2000), which end where the surface is narrow.
"""

import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.cluster.vq import kmeans2
from scipy.sparse.csgraph import connected_components, dijkstra
from torch import Tensor
from torch.nn import functional

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.fitting.node_pose import Pose, Turns, rotation
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.transform import thinned
from dg4d_lib.mesh.models.control_graph import ControlGraph, symmetric_matrix
from dg4d_lib.rasterizer.interface import Rasterizer

SIZE = 64  # pixels of the compared pictures, at most
RENDERED = 1000  # largest number of Gaussians, about
BATCH = 64  # pictures at once
LEVELS = 3  # of the image pyramid
BRANCHES = (0.15, 0.3, 0.45, 0.6, 0.75, 0.9)  # quantiles of the distance from the middle where branches begin
CLUSTERS = (2, 4, 6, 9, 12)  # numbers of clusters
SMALLEST, LARGEST = 3, 0.65  # least number of nodes of a part, and its largest share of all nodes
SAME = 0.85  # IoU from which two parts are one
ANGLES = (15.0, 35.0, 65.0, 105.0)  # trial rotations, degrees
FINER = (12.0, 6.0)  # degrees of the steps that refine a rotation
REFINED = 6  # parts whose best rotation is refined, per round
ROUNDS = 3  # parts that are turned one after the other, at most
PENALTY = 0.2  # penalty on a rotation by 180 degrees, relative to the error before
GAIN = 0.05  # least relative decrease of the error by a part


@dataclass(frozen=True)
class Part:
    """A part of a model.

    Attributes:
        nodes: whether a control node belongs to it.
        joint: edges of the graph that leave it.
    """

    nodes: Bool[np.ndarray, " m"]
    joint: Int[np.ndarray, "e 2"]


@dataclass(frozen=True)
class _Hinge:
    """A part in its present pose, with the center of its joint and, as rows, the principal axes of the joint."""

    nodes: Bool[np.ndarray, " m"]
    center: Float[np.ndarray, " 3"]
    directions: Float[np.ndarray, "3 3"]


def find_parts(graph: ControlGraph) -> list[Part]:
    """Return the parts of a model that may move on their own, the largest first; they overlap."""
    edges, lengths = graph.edges.numpy(), graph.lengths.double().numpy()
    count = len(graph.nodes)
    found = [*_branches(edges, lengths, count), *_clusters(edges, lengths, count)]
    kept: list[Bool[np.ndarray, " m"]] = []
    for nodes in sorted(found, key=lambda nodes: -int(nodes.sum())):
        sized = SMALLEST <= nodes.sum() <= LARGEST * count
        if sized and all((nodes & other).sum() < SAME * (nodes | other).sum() for other in kept):
            kept.append(nodes)
    parts = [Part(nodes, edges[nodes[edges[:, 0]] != nodes[edges[:, 1]]]) for nodes in kept]
    return [part for part in parts if len(part.joint)]


class PartSearch:
    """Turns parts of a model until its render is like a frame."""

    def __init__(
        self,
        cloud: Gaussians,
        graph: ControlGraph,
        pictures: Float[Tensor, "t s s 3"],
        alphas: Float[Tensor, "t s s 1"],
        backdrop: float,
        rasterize: Rasterizer,
    ) -> None:
        """Store the model and the frames.

        Args:
            cloud: Gaussians of the model at rest.
            graph: control graph whose points are the Gaussians.
            pictures: frames over the backdrop.
            alphas: of the frames.
            backdrop: its gray value.
            rasterize: rasterizer.
        """
        step = -(-len(cloud) // RENDERED)
        thin = thinned(cloud, step)
        sizes = thin.log_scales.mean(-1, keepdim=True).expand(-1, 3)
        self._cloud = replace(thin, log_scales=sizes)  # round, for they are not turned
        self._graph, self._rasterize = graph.of(torch.arange(0, len(cloud), step)), rasterize
        size = min(SIZE, pictures.shape[1])
        self._camera = replace(OrbitCamera(), width=size, height=size)
        self._backdrop = pictures.new_full((3,), backdrop)
        frames = torch.cat([pictures, alphas], -1).movedim(-1, 1)
        self._frames = functional.interpolate(frames, size=(size, size), mode="area")
        self._nodes = graph.nodes.double().numpy()
        self._parts = find_parts(graph)
        self._turns = np.concatenate([_rotations_by(angle) for angle in ANGLES])

    def best_pose(self, pose: Pose, frame: int) -> Pose:
        """Return the pose after up to `ROUNDS` parts were turned; the same object if no part lowers the error."""
        everything = np.ones(len(self._nodes), bool)
        still = _Hinge(everything, self._nodes.mean(0), np.eye(3))
        first = best = float(self._errors(self._shares(pose), frame, still, np.eye(3)[None])[0])
        for _ in range(ROUNDS):
            places = self._nodes + pose.shifts
            costs_of = partial(self._costs, self._shares(pose), frame, first)
            hinges = [replace(still, center=places.mean(0)), *(_hinge(part, places) for part in self._parts)]
            costs = [costs_of(hinge, self._turns) for hinge in hinges]
            promising = np.argsort([cost.min() for cost in costs], kind="stable")[:REFINED]
            refined = [
                (*_refine_rotation(partial(costs_of, hinges[k]), self._turns[int(costs[k].argmin())]), k)
                for k in promising
            ]
            cost, turn, selected = min(refined, key=lambda one: one[0])
            if cost > (1 - GAIN) * best:
                break
            best, pose = cost, self._turn_part(pose, hinges[selected], turn)
        return pose

    def _turn_part(self, pose: Pose, hinge: _Hinge, turn: Float[np.ndarray, "3 3"]) -> Pose:
        """Return a pose with a part turned about its joint, by a rotation in the hinge's directions."""
        turn = hinge.directions.T @ turn @ hinge.directions
        turns, shifts, own = pose.turns.copy(), pose.shifts.copy(), hinge.nodes
        turns[own] = turn @ pose.turns[own]
        arms = (self._nodes + pose.shifts)[own] - hinge.center
        shifts[own] = arms @ turn.T + hinge.center - self._nodes[own]
        return Pose(turns, shifts)

    def _costs(
        self,
        shares: Float[np.ndarray, "n k 3"],
        frame: int,
        scale: float,
        hinge: _Hinge,
        turns: Float[np.ndarray, "b 3 3"],
    ) -> Float[np.ndarray, " b"]:
        """Return errors with a penalty on large rotations, which are in the hinge's directions."""
        angles = np.arccos(((np.trace(turns, axis1=1, axis2=2) - 1) / 2).clip(-1, 1))
        return self._errors(shares, frame, hinge, turns) + PENALTY * scale * np.square(angles / np.pi)

    def _shares(self, pose: Pose) -> Float[np.ndarray, "n k 3"]:
        """Return the contribution of each of its nodes to the mean of every Gaussian."""
        index, weights = self._graph.indices.numpy(), self._graph.weights.double().numpy()
        return pose.shares(self._cloud.means.double().numpy(), self._nodes, index, weights)[0]

    @torch.no_grad()
    def _errors(
        self, shares: Float[np.ndarray, "n k 3"], frame: int, hinge: _Hinge, turns: Float[np.ndarray, "b 3 3"]
    ) -> Float[np.ndarray, " b"]:
        """Return the mean squared differences of renders and a frame over a pyramid, for rotations of a part."""
        own = hinge.nodes[self._graph.indices.numpy()]
        turning = (shares * own[..., None]).sum(1)  # n 3; the rest stays
        center = hinge.center * (self._graph.weights.numpy() * own).sum(1)[:, None]
        rest, arms = (torch.from_numpy(one).float() for one in (shares.sum(1) - turning + center, turning - center))
        errors = []
        for some in torch.from_numpy(hinge.directions.T @ turns @ hinge.directions).float().split(BATCH):
            count = len(some)
            states = replace(
                self._cloud,
                means=arms @ some.mT + rest,
                log_scales=self._cloud.log_scales.expand(count, -1, -1),
                quats=self._cloud.quats.expand(count, -1, -1),
            )
            rendering = self._rasterize(states, [self._camera] * count, self._backdrop)
            errors.append(
                _pyramid(torch.cat([rendering.color, rendering.alpha], -1).movedim(-1, 1) - self._frames[frame])
            )
        return torch.cat(errors).double().numpy()


def _refine_rotation(
    costs_of: Callable[[Float[np.ndarray, "b 3 3"]], Float[np.ndarray, " b"]], turn: Float[np.ndarray, "3 3"]
) -> tuple[float, Float[np.ndarray, "3 3"]]:
    """Return the cost and the best of the rotations near one."""
    best = np.inf
    for angle in FINER:
        near = np.concatenate([turn[None], _rotations_by(angle) @ turn])
        costs = costs_of(near)
        best, turn = float(costs.min()), near[int(costs.argmin())]
    return best, turn


def _hinge(part: Part, places: Float[np.ndarray, "m 3"]) -> _Hinge:
    at = places[part.joint].mean(1)
    center = at.mean(0)
    return _Hinge(part.nodes, center, np.linalg.svd(at - center)[2])


def _rotations_by(angle: float) -> Turns:
    """Return rotations by an angle in degrees about 26 axes, along sides and diagonals of a cube."""
    axes = np.array([axis for axis in product((-1.0, 0.0, 1.0), repeat=3) if any(axis)])
    return rotation(np.deg2rad(angle) * axes / np.linalg.norm(axes, axis=1, keepdims=True))


def _pyramid(difference: Float[Tensor, "b c h w"]) -> Float[Tensor, " b"]:
    """Return the mean square after a filter of 3 x 3 pixels, averaged over levels of half the size each."""
    tall = functional.pad(difference, (1, 1, 1, 1))
    tall = tall[..., :-2, :] + tall[..., 1:-1, :] + tall[..., 2:, :]
    level = (tall[..., :-2] + tall[..., 1:-1] + tall[..., 2:]) / 9  # a tenth of the time of avg_pool2d
    total = level.square().mean((1, 2, 3))
    for _ in range(LEVELS - 1):
        level = functional.avg_pool2d(level, 2)
        total = total + level.square().mean((1, 2, 3))
    return total / LEVELS


def _branches(
    edges: Int[np.ndarray, "e 2"], lengths: Float[np.ndarray, " e"], count: int
) -> Iterable[Bool[np.ndarray, " m"]]:
    distances = dijkstra(symmetric_matrix(edges, lengths, count), directed=False)
    distances[np.isinf(distances)] = distances[np.isfinite(distances)].max()
    reach = distances[int(distances.sum(1).argmin())]
    for share in BRANCHES:
        far = reach > np.quantile(reach, share)
        inside = edges[far[edges].all(1)]
        labels = connected_components(symmetric_matrix(inside, np.ones(len(inside)), count), directed=False)[1]
        yield from (far & (labels == label) for label in np.unique(labels[far]))


def _clusters(
    edges: Int[np.ndarray, "e 2"], lengths: Float[np.ndarray, " e"], count: int
) -> Iterable[Bool[np.ndarray, " m"]]:
    near = symmetric_matrix(edges, lengths.mean() / lengths, count).toarray()
    scale = 1 / np.sqrt(near.sum(1).clip(1e-12))
    vectors = np.linalg.eigh(np.eye(count) - near * scale[:, None] * scale)[1]
    for number in CLUSTERS:
        if number >= count:
            break
        rows = vectors[:, :number] / np.linalg.norm(vectors[:, :number], axis=1, keepdims=True).clip(1e-12)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "One of the clusters is empty")
            labels = kmeans2(rows, number, minit="++", seed=0)[1]
        yield from (labels == label for label in range(number))
