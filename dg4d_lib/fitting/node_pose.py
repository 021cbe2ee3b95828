"""Rigid transforms of control nodes at one frame."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation
from torch import Tensor

CONTINUED = 0.5  # share of the last motion that is extrapolated

Turns = Float[np.ndarray, "m 3 3"]
Shifts = Float[np.ndarray, "m 3"]


@dataclass(frozen=True)
class Pose:
    """Rigid transforms of the nodes at one frame.

    Attributes:
        turns: rotation matrices about the nodes at rest.
        shifts: translations of the nodes, world units.
    """

    turns: Turns
    shifts: Shifts

    @classmethod
    def rest(cls, count: int) -> "Pose":
        """Return the rest pose of `count` nodes."""
        return cls(np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)))

    def quats(self) -> Float[Tensor, "m 4"]:
        """Return the rotations as unit quaternions, wxyz, w not negative."""
        found = Rotation.from_matrix(self.turns).as_quat(canonical=True)
        return torch.from_numpy(np.roll(found, 1, -1)).float()

    def shares(
        self,
        points: Float[np.ndarray, "n 3"],
        nodes: Float[np.ndarray, "m 3"],
        index: Int[np.ndarray, "n k"],
        weights: Float[np.ndarray, "n k"],
    ) -> tuple[Float[np.ndarray, "n k 3"], Float[np.ndarray, "n k 3"]]:
        """Return each node's weighted contribution to the point, and the rotated offset from the node to the point.

        Args:
            points: at rest.
            nodes: at rest.
            index: nodes that move every point.
            weights: of these nodes.
        """
        arms = np.einsum("nkij,nkj->nki", self.turns[index], points[:, None] - nodes[index])
        return weights[..., None] * (arms + nodes[index] + self.shifts[index]), arms

    def continued(self, last: "Pose") -> "Pose":
        """Continue from this pose over the last one, at part of the speed."""
        return Pose(
            rotation(CONTINUED * rotation_vector(last.turns @ self.turns.swapaxes(1, 2))) @ last.turns,
            last.shifts + CONTINUED * (last.shifts - self.shifts),
        )


def rotation(vectors: Shifts) -> Turns:
    """Return rotations by vectors along the axis, of the length of the angle."""
    found: Turns = Rotation.from_rotvec(vectors).as_matrix()
    return found


def rotation_vector(turns: Turns) -> Shifts:
    """Return the vectors of rotations; see `rotation`."""
    found: Shifts = Rotation.from_matrix(turns).as_rotvec()
    return found
