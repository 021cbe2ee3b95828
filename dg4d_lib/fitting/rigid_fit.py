"""Motion of few rigid parts, fitted to all frames of a driving video together by Gauss-Newton steps.

A rigid part shows in its size how far it is, and in its outline how it is turned, where a surface that may stretch
crumples instead. So displacements in depth are not penalized. Six variables per part and frame are few enough for
second-order steps, which find depth as fast as what moves in the picture.
"""

import math
from collections.abc import Callable
from functools import partial

import torch
from jaxtyping import Float, Float64, Int
from torch import Tensor

from dg4d_lib.fitting.asset_fit import AssetFit
from dg4d_lib.fitting.rigid_parts import RigidMotion
from dg4d_lib.fitting.rigidity import robust
from dg4d_lib.geometry.quaternion import rotate

ITERATIONS = 24  # largest number
SHIFT, SHIFT_IN_DEPTH, TURN = 0.001, 0.0025, 0.002  # forward differences, world units; turns at the radius of a part
SMALLEST_RADIUS = 0.03  # world units
FARTHEST, WIDEST = 0.1, 0.4  # largest step of a part, world units and radians
DAMPING, LESS, MORE = 1e-3, 0.3, 6.0  # relative to the diagonal at first; factors after success and failure
INERTIA, JOINTS = 0.1, 0.1  # factors on acceleration and rigidity weights: parts may move abruptly, lids lift off
SMALLEST_DAMPING, TRIES = 1e-5, 5
SMALLEST_GAIN = 0.01  # relative decrease of the loss by one step, below which the fit ends
TOGETHER = 8  # frames whose derivatives are held in memory


def fit_rigid_motion(
    fit: AssetFit,
    start: RigidMotion,
    report: Callable[[int, dict[str, float]], None] = lambda iteration, values: None,
    hinge: Int[Tensor, " e"] | None = None,
) -> RigidMotion:
    """Fit the motions of rigid parts: pictures, a plane of symmetry that is kept, accelerations, joints.

    Args:
        fit: what is compared.
        start: near the solution.
        report: called after every step with (steps done, named losses).
        hinge: edges of the graph that alone hold the parts together; None: all between parts, weakly.
    """
    with torch.no_grad():
        problem, found, damping = _Problem(fit, start, hinge), start, DAMPING
        held = 6 * len(start.centers) if fit.resting else 0  # variables of the first frame
        loss = problem.loss(found)
        for step in range(ITERATIONS):
            before = loss
            matrix, gradient = problem.normal_equations(found)
            for _ in range(TRIES):
                damped = matrix + torch.diag(damping * matrix.diagonal() + 1e-8)
                change = torch.zeros_like(gradient)
                change[held:] = -torch.linalg.solve(damped[held:, held:], gradient[held:])
                candidate = found.changed(_limit_steps(change.view(*found.quats.shape[:2], 6).to(found.places)))
                loss = problem.loss(candidate)
                if loss < before:
                    found, damping = candidate, max(LESS * damping, SMALLEST_DAMPING)
                    break
                damping *= MORE
            report(step + 1, {"rigid parts": min(loss, before) / len(found.quats)})
            if loss > (1 - SMALLEST_GAIN) * before:
                break
    return found


class _Problem:
    """Least squares over the variables of all parts and frames."""

    def __init__(self, fit: AssetFit, start: RigidMotion, hinge: Int[Tensor, " e"] | None = None) -> None:
        self.fit, self.graph = fit, fit.graph
        ends = start.parts[self.graph.edges]
        self.joints = torch.nonzero(ends[:, 0] != ends[:, 1])[:, 0] if hinge is None else hinge
        self.joint_weight = JOINTS if hinge is None else 1.0
        self.deltas = [_differences(fit, start, part) for part in range(len(start.centers))]

    def loss(self, motion: RigidMotion) -> float:
        """Return the sum of the squares."""
        total = float((self._inertia * self._nodes(motion).diff(n=2, dim=0)).square().sum())
        return total + sum(
            float(self._residuals(motion.at(selected), selected).square().sum())
            for selected in self._frame_chunks(motion)
        )

    def normal_equations(self, motion: RigidMotion) -> tuple[Float64[Tensor, "n n"], Float64[Tensor, " n"]]:
        """Return the matrix and half of the gradient by all variables, ordered by frame, part and coordinate."""
        frames, count = len(motion.quats), 6 * len(self.deltas)
        nodes = self._nodes(motion)
        moves = self._derivative(motion, lambda one: self._nodes(one).flatten(1)).double()  # t 3m n
        accelerate = self._inertia * torch.eye(frames, dtype=torch.float64, device=moves.device).diff(n=2, dim=0)
        stiffness = accelerate.T @ accelerate  # couples the frames
        coupled = torch.einsum("tu,tin,uim->tnum", stiffness, moves, moves)
        gradient = torch.einsum("tin,ti->tn", moves, stiffness @ nodes.flatten(1).double())
        for selected in self._frame_chunks(motion):
            piece = motion.at(selected)
            residuals = self._residuals(piece, selected)
            derivative = self._derivative(piece, partial(self._residuals, frames=selected))
            squares = (derivative.mT @ derivative).double()
            for frame, square in zip(range(selected.start, selected.stop), squares, strict=True):
                coupled[frame, :, frame] += square
            gradient[selected] += (derivative.mT @ residuals[..., None])[..., 0].double()
        return coupled.reshape(frames * count, -1), gradient.reshape(-1)

    @property
    def _inertia(self) -> float:
        return math.sqrt(INERTIA * self.fit.settings.smoothness / len(self.graph.nodes))

    def _nodes(self, motion: RigidMotion) -> Float[Tensor, "t m 3"]:
        return self.fit.relative(motion.of_nodes(self.graph).nodes(self.graph))

    def _residuals(self, motion: RigidMotion, frames: slice) -> Float[Tensor, "t r"]:
        """Return the residuals: differences of pictures and displacements, and robust gaps at the joints."""
        moved = motion.of_nodes(self.graph)
        seen = self.fit.residuals(moved, list(range(frames.start, frames.stop)))
        edges, settings = self.graph.edges[self.joints], self.fit.settings
        spans, lengths = self.graph.spans[self.joints], self.graph.lengths[self.joints, None]
        nodes, turns = moved.nodes(self.graph), moved.matrices
        gaps = nodes[:, edges[:, 1]] - nodes[:, edges[:, 0]]
        turned = [rotate(turns[:, edges[:, end]], spans) for end in (0, 1)]
        stretch = torch.cat([(gaps - one) / lengths for one in turned], 1)
        size = stretch.norm(dim=-1, keepdim=True).clamp(min=1e-9)
        loss = robust(stretch, settings.rigidity_loss == "log").clamp(min=0)[..., None]
        weight = math.sqrt(self.joint_weight * settings.rigidity / (2 * len(self.graph.edges)))
        return torch.cat([seen, (weight * loss.sqrt() / size * stretch).flatten(1)], 1)

    def _derivative(
        self, motion: RigidMotion, function: Callable[[RigidMotion], Float[Tensor, "t r"]]
    ) -> Float[Tensor, "t r n"]:
        """Return the derivatives of values per frame by the variables of that frame, by forward differences."""
        start, columns = function(motion), []
        for part, deltas in enumerate(self.deltas):
            for coordinate, delta in enumerate(deltas):
                change = torch.zeros(*motion.quats.shape[:2], 6, dtype=start.dtype, device=start.device)
                change[:, part, coordinate] = delta
                columns.append((function(motion.changed(change)) - start) / delta)
        return torch.stack(columns, -1)

    @staticmethod
    def _frame_chunks(motion: RigidMotion) -> list[slice]:
        frames = len(motion.quats)
        return [slice(first, min(first + TOGETHER, frames)) for first in range(0, frames, TOGETHER)]


def _differences(fit: AssetFit, start: RigidMotion, part: int) -> list[float]:
    """Return the forward differences of the variables of a part: three shifts, then three turns."""
    nodes = fit.graph.nodes[start.parts == part]
    radius = (nodes - start.centers[part]).square().sum(-1).mean().sqrt()
    return [SHIFT, SHIFT, SHIFT_IN_DEPTH, *[TURN / max(float(radius), SMALLEST_RADIUS)] * 3]


def _limit_steps(change: Float[Tensor, "t k 6"]) -> Float[Tensor, "t k 6"]:
    """Scale the steps down at frames where a part would move too far."""
    size = torch.maximum(change[..., :3].abs() / FARTHEST, change[..., 3:].abs() / WIDEST).amax((1, 2))
    return change / size.clamp(min=1)[:, None, None]
