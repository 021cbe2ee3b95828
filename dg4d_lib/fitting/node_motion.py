"""Motions of control nodes, and the variables that a descent finds them by.

Variables are smoothed over the graph, so that nodes that the video does not show move with those that it shows
(Nicolet et al. 2021). Where rotations are integrated, the nodes are placed by them (a Poisson equation, Yu et al. 2004)
and shifts are added: a step that turns a shoulder swings the arm, where along shifts alone a raised wing would shrink.
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from dg4d_lib.fitting.frame_variables import FrameVariables
from dg4d_lib.fitting.node_kernels import has_kernels, moved_points, turned_edges
from dg4d_lib.fitting.node_pose import Pose
from dg4d_lib.geometry.quaternion import quat_multiply, quat_to_rotmat, rotate
from dg4d_lib.mesh.models.control_graph import ControlGraph

SMALLEST_REAL = 0.05  # part of a quaternion: turns by half a circle have no vector
BETA1, BETA2 = 0.9, 0.99  # of Adam
FACTORS = {"turns": 6.0, "shifts": 3.0, "global_turns": 2.0, "global_shifts": 1.0}  # of the learning rate, per variable
INTEGRATED_FACTORS = FACTORS | {"turns": 24.0, "shifts": 1.5}  # likewise, where rotations are integrated


@dataclass(frozen=True)
class NodeMotion:
    """Rigid transforms of the nodes at every frame, and of the whole model.

    Attributes:
        quats: rotations of the nodes, wxyz, any norm from 1e-10 to 1e18.
        shifts: translations of the nodes.
        global_quats: rotation of the whole model about the centroid of the nodes.
        global_shifts: translation of the whole model.
    """

    quats: Float[Tensor, "t m 4"]
    shifts: Float[Tensor, "t m 3"]
    global_quats: Float[Tensor, "t 4"]
    global_shifts: Float[Tensor, "t 3"]

    @property
    def parts(self) -> Int[Tensor, " m"]:
        """Rigid part of every node, from 0 on: nodes with equal rotations at all frames are one part."""
        found: Tensor = torch.unique(self.quats.transpose(0, 1).flatten(1), dim=0, return_inverse=True)[1]
        return found

    def at(self, frames: slice | Int[Tensor, " k"]) -> "NodeMotion":
        """Return the motion of some frames."""
        return NodeMotion(
            self.quats[frames], self.shifts[frames], self.global_quats[frames], self.global_shifts[frames]
        )

    @cached_property
    def matrices(self) -> Float[Tensor, "t m 3 3"]:
        """Rotations of the nodes."""
        return quat_to_rotmat(self.quats)

    @cached_property
    def _global_matrices(self) -> Float[Tensor, "t 3 3"]:
        return quat_to_rotmat(self.global_quats)

    def points(self, rest: Float[Tensor, "v 3"], graph: ControlGraph) -> Float[Tensor, "t v 3"]:
        """Return the points that the nodes of `graph` move, at every frame."""
        if has_kernels(self.quats):
            moved = moved_points(self.quats, self.shifts, graph.nodes, rest, graph.indices, graph.weights)
            return self._placed(moved, graph)
        origins = graph.nodes + self.shifts - rotate(self.matrices, graph.nodes)  # x -> R x + origin
        affine = torch.cat([self.matrices, origins[..., None]], -1).flatten(2)  # t m 12
        blended = graph.blend(affine).unflatten(-1, (3, 4))
        return self._placed(rotate(blended[..., :3], rest) + blended[..., 3], graph)

    def nodes(self, graph: ControlGraph) -> Float[Tensor, "t m 3"]:
        """Return the nodes at every frame."""
        return self._placed(graph.nodes + self.shifts, graph)

    def rotations(self, graph: ControlGraph) -> Float[Tensor, "t v 4"]:
        """Return the blended rotations of the points, unit quaternions."""
        blended = graph.blend_rotations(functional.normalize(self.quats, dim=-1))
        turn = functional.normalize(self.global_quats, dim=-1)
        return quat_multiply(turn[:, None].expand_as(blended), blended)

    def _placed(self, points: Float[Tensor, "t v 3"], graph: ControlGraph) -> Float[Tensor, "t v 3"]:
        center = graph.nodes.mean(0)
        turned = (points - center) @ self._global_matrices.mT
        return turned + center + self.global_shifts[:, None]


class NodeBasis:
    """Map from the variables of a descent to motions: smoothing over the graph, and Poisson integration of rotations.

    Attributes:
        smoothing: matrix that the variables of the nodes are multiplied by.
        integrated: the shifts that follow from the rotations are added to the variables'.
    """

    def __init__(self, graph: ControlGraph, strength: float, integrated: bool) -> None:
        self.smoothing = _smoothing(graph, strength)
        self.integrated = integrated
        self._graph = graph
        self._centered = graph.nodes - graph.nodes.mean(0)
        self._integral = _integral(graph) if integrated else None

    def integral(self, quats: Float[Tensor, "t m 4"]) -> Float[Tensor, "t m 3"]:
        """Return the shifts, mean 0, that rotate every edge with its ends, by least squares; 0 if not integrated."""
        if self._integral is None:
            return torch.zeros_like(quats[..., 1:])
        if has_kernels(quats):
            return self._integral @ turned_edges(quats, self._graph.spans, self._graph.edges) - self._centered
        first, second = self._graph.at_ends(quat_to_rotmat(quats).flatten(2))
        turns = (0.5 * (first + second)).unflatten(-1, (3, 3))
        return self._integral @ rotate(turns, self._graph.spans) - self._centered


@dataclass(frozen=True)
class NodeVariables(FrameVariables):
    """Transforms of the nodes and of the whole model before smoothing, rotations as vectors.

    Attributes:
        turns: along the axis, of twice the tangent of half the angle.
        shifts: world units.
        global_turns: like `turns`, for the whole model.
        global_shifts: like `shifts`, for the whole model.
    """

    turns: Float[Tensor, "t m 3"]
    shifts: Float[Tensor, "t m 3"]
    global_turns: Float[Tensor, "t 3"]
    global_shifts: Float[Tensor, "t 3"]

    @classmethod
    def still(cls, frames: int, graph: ControlGraph) -> "NodeVariables":
        """Return the variables of nodes at rest."""
        zeros, still = graph.nodes.new_zeros(frames, len(graph.nodes), 3), graph.nodes.new_zeros(frames, 3)
        return cls(zeros, zeros, still, still)

    @classmethod
    def of(cls, pose: Pose, basis: NodeBasis) -> "NodeVariables":
        """Return the variables of a tracked pose."""
        quats = pose.quats()
        turns = 2 * quats[:, 1:] / quats[:, :1].clamp(min=SMALLEST_REAL)
        shifts, still = torch.from_numpy(pose.shifts).to(turns), turns.new_zeros(1, 3)
        remaining = shifts - basis.integral(quats[None])[0]
        rough = [torch.linalg.solve(basis.smoothing, one)[None] for one in (turns, remaining)]
        return cls(rough[0], rough[1], still, still)

    def motion(self, basis: NodeBasis) -> NodeMotion:
        """Return the motion of the nodes and of the whole model."""
        quats = _quats(basis.smoothing @ self.turns)
        shifts = basis.smoothing @ self.shifts + basis.integral(quats)
        return NodeMotion(quats, shifts, _quats(self.global_turns), self.global_shifts)


class Descent:
    """Adam with about one step size for all coordinates of a variable and frame, so that weak gradients stay weak.

    As steps do not shrink with gradients, they would move a first frame that is solved: `held` says how many first
    frames stay as they are. An `evenness` below 1 mixes in steps of their own for the coordinates.
    """

    def __init__(
        self, values: dict[str, Tensor], factors: dict[str, float], held: int = 0, evenness: float = 1.0
    ) -> None:
        self.values, self.factors, self.held, self.evenness = values, factors, held, evenness
        self.first = {name: torch.zeros_like(value) for name, value in self.values.items()}
        self.second = {name: torch.zeros_like(value) for name, value in self.values.items()}
        self.count = 0

    @torch.no_grad()
    def step(self, lr: float) -> None:
        """Move all variables by their gradients."""
        self.count += 1
        for name, value in self.values.items():
            if value.grad is None:
                continue
            first, second = self.first[name], self.second[name]
            first.lerp_(value.grad, 1 - BETA1)
            second.lerp_(value.grad.square(), 1 - BETA2)
            square = second / (1 - BETA2**self.count)
            largest = square.flatten(1).amax(1).view(-1, *[1] * (second.dim() - 1))
            size = self.evenness * largest.sqrt() + (1 - self.evenness) * square.sqrt()
            moment = first / (1 - BETA1**self.count)
            change = lr * self.factors[name] * moment / (size + 1e-12)
            value[self.held :].sub_(change[self.held :])


class NodeDescent(Descent):
    """Descent over the variables of nodes."""

    def __init__(self, variables: NodeVariables, basis: NodeBasis, held: int = 0) -> None:
        super().__init__(vars(variables), INTEGRATED_FACTORS if basis.integrated else FACTORS, held)


def _quats(turns: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4"]:
    """Return rotations for vectors along the axis of twice the tangent of half the angle."""
    return torch.cat([torch.ones_like(turns[..., :1]), 0.5 * turns], -1)


def _smoothing(graph: ControlGraph, strength: float) -> Float[Tensor, "m m"]:
    """Return (I + strength L)^-1 with the Laplacian L of the graph, scaled to keep a uniform motion."""
    count = len(graph.nodes)
    laplacian = torch.zeros(count, count, dtype=torch.float64)
    first, second = graph.edges.T
    laplacian[first, second] = -1.0
    laplacian[second, first] = -1.0
    laplacian.diagonal().copy_(-laplacian.sum(1))
    inverse: Tensor = torch.linalg.inv(torch.eye(count, dtype=torch.float64) + strength * laplacian)
    return inverse.to(graph.nodes)


def _integral(graph: ControlGraph) -> Float[Tensor, "m e"]:
    """Return the matrix from vectors of the edges to node positions, mean 0: weighted least squares over lengths."""
    first, second = graph.edges.T
    rows, weights = torch.arange(len(first)), graph.lengths.double() ** -2
    ends = torch.zeros(len(first), len(graph.nodes), dtype=torch.float64)
    ends[rows, first], ends[rows, second] = -1.0, 1.0
    laplacian = ends.T @ (weights[:, None] * ends)
    inverse: Tensor = torch.linalg.pinv(laplacian, hermitian=True) @ (ends.T * weights)
    return inverse.to(graph.nodes)
