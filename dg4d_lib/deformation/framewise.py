"""Per-frame displacements without a shared model (ablation of the deformation field in the paper)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from dg4d_lib.deformation.interface import Displacement
from dg4d_lib.errors import BadInput


def interpolated(table: Float[Tensor, "t n c"], times: Float[Tensor, " k"]) -> Float[Tensor, "k n c"]:
    """Return the rows of a table over frames at times in [0, 1], linearly between frames."""
    last = table.shape[0] - 1
    position = times.clamp(0, 1) * last
    left = position.floor().clamp(0, max(last - 1, 0)).long()
    weight = (position - left)[:, None, None]
    return table[left] * (1 - weight) + table[(left + 1).clamp(max=last)] * weight


class Framewise(nn.Module):
    """Table of displacements, interpolated linearly between frames.

    Args:
        frames: number of frames, t.
        count: number of Gaussians, n.
        scatter: radius of the ball from which initial displacements of the means are drawn, independently per frame;
            world units.
        generator: draws them.
    """

    def __init__(self, frames: int, count: int, scatter: float = 0.0, generator: torch.Generator | None = None) -> None:
        super().__init__()
        table = torch.zeros(frames, count, 10)
        if scatter:
            directions = functional.normalize(torch.randn(frames, count, 3, generator=generator), dim=-1)
            radii = torch.rand(frames, count, 1, generator=generator) ** (1 / 3)  # uniform density in the ball
            table[..., :3] = scatter * radii * directions
        self.table = nn.Parameter(table)

    def displace(self, means: Float[Tensor, "n 3"], times: Float[Tensor, " t"]) -> Displacement:
        """Return the displacements at times in [0, 1]; of the means only their number matters.

        Raises:
            BadInput: the number of Gaussians differs from the table's.
        """
        if len(means) != self.table.shape[1]:
            raise BadInput(f"this frame-wise deformation has {self.table.shape[1]} Gaussians; given {len(means)}")
        rows = interpolated(self.table, times)
        return Displacement(rows[..., :3], rows[..., 3:6], rows[..., 6:])

    def grid_parameters(self) -> list[nn.Parameter]:
        """Return the parameters that use `plane_lr`: all."""
        return [self.table]

    def length_parameters(self) -> list[nn.Parameter]:
        """Return none: one table holds lengths and all else."""
        return []

    def regularization_loss(self) -> Float[Tensor, ""]:
        """Return zero: the table has no regularizer."""
        return self.table.new_zeros(())
