"""MLP deformation field over position and time (ablation of the deformation field in the paper)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from dg4d_lib.deformation.hexplane import Heads
from dg4d_lib.deformation.interface import Displacement
from dg4d_lib.settings import MlpSettings


class Mlp(nn.Module):
    """Positional encoding of position and time, two layers, and the zero-initialized heads of HexPlane.

    Args:
        settings: sizes.
        bounds: lower and upper corner of the box that maps to [-1, 1], world units.
        generator: initializes the layers.
        last: time of the last frame on the network's time axis, which ends at 1.
    """

    bounds: Tensor

    def __init__(
        self,
        settings: MlpSettings,
        bounds: Float[Tensor, "2 3"],
        generator: torch.Generator | None = None,
        last: float = 1.0,
    ) -> None:
        super().__init__()
        self.settings, self.last = settings, last
        self.register_buffer("bounds", bounds)
        self.first = nn.Linear(4 * (1 + 2 * settings.frequencies), settings.hidden)
        self.second = nn.Linear(settings.hidden, settings.hidden)
        for layer in (self.first, self.second):
            nn.init.xavier_uniform_(layer.weight, generator=generator)
            nn.init.zeros_(layer.bias)
        self.heads = Heads(settings.hidden)

    def displace(self, means: Float[Tensor, "n 3"], times: Float[Tensor, " t"]) -> Displacement:
        """Return the displacements at times in [0, 1]."""
        low, high = self.bounds
        position = ((means - low) / (high - low) * 2 - 1).expand(len(times), -1, -1)
        time = (2 * self.last * times - 1)[:, None, None].expand(-1, len(means), 1)
        encoded = encode(torch.cat([position, time], -1), self.settings.frequencies)
        displacement: Displacement = self.heads(self.second, functional.relu(self.first(encoded)))
        return displacement

    def grid_parameters(self) -> list[nn.Parameter]:
        """Return the parameters that use `plane_lr`: none."""
        return []

    def length_parameters(self) -> list[nn.Parameter]:
        """Return the parameters that carry the unit of length: the last layer of the head of the means."""
        return list(self.heads.means.outer.parameters())

    def regularization_loss(self) -> Float[Tensor, ""]:
        """Return zero: the network has no regularizer."""
        return self.bounds.new_zeros(())


def encode(values: Float[Tensor, "*b d"], frequencies: int) -> Float[Tensor, "*b e"]:
    """Return the values and their positional encoding: sines and cosines of pi 2^k x (Mildenhall et al. 2020)."""
    octaves = 2.0 ** torch.arange(frequencies, dtype=values.dtype, device=values.device)
    angles = values[..., None, :] * (torch.pi * octaves)[:, None]
    return torch.cat([values, angles.sin().flatten(-2), angles.cos().flatten(-2)], -1)
