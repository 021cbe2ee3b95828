"""Ablation: every frame has its own free displacement (paper, ablation of the deformation field)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from dg4d_lib.deformation.interface import Displacement
from dg4d_lib.errors import BadInput


class Framewise(nn.Module):
    """A table of displacements; linear between frames.

    Args:
        frames: t.
        count: Gaussians, n.
        scatter: how far from its place at rest a Gaussian may begin, at random and in every frame anew, world units.
        generator: of these beginnings.
    """

    def __init__(self, frames: int, count: int, scatter: float = 0.0, generator: torch.Generator | None = None) -> None:
        super().__init__()
        table = torch.zeros(frames, count, 10)
        if scatter:
            directions = functional.normalize(torch.randn(frames, count, 3, generator=generator), dim=-1)
            shares = torch.rand(frames, count, 1, generator=generator) ** (1 / 3)  # evenly over the ball
            table[..., :3] = scatter * shares * directions
        self.table = nn.Parameter(table)

    def displace(self, means: Float[Tensor, "n 3"], times: Float[Tensor, " t"]) -> Displacement:
        """What to add at every time in [0, 1]; the means only have to be as many as the table's.

        Raises:
            BadInput: another number of Gaussians than the table was made for.
        """
        if len(means) != self.table.shape[1]:
            raise BadInput(f"a frame-wise motion of {self.table.shape[1]} Gaussians cannot move {len(means)}")
        last = self.table.shape[0] - 1
        place = times.clamp(0, 1) * last
        left = place.floor().clamp(0, max(last - 1, 0)).long()
        share = (place - left)[:, None, None]
        rows = self.table[left] * (1 - share) + self.table[(left + 1).clamp(max=last)] * share
        return Displacement(rows[..., :3], rows[..., 3:6], rows[..., 6:])

    def grid_parameters(self) -> list[nn.Parameter]:
        """The parameters that learn at the rate of planes: all."""
        return [self.table]

    def regularization_loss(self) -> Float[Tensor, ""]:
        """A table has no regularizer: zero."""
        return self.table.new_zeros(())
