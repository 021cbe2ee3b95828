"""Ablation: one network over place and time instead of planes (paper, ablation of the deformation field)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from dg4d_lib.deformation.hexplane import Heads
from dg4d_lib.deformation.interface import Displacement
from dg4d_lib.settings import MlpSettings


class Mlp(nn.Module):
    """Sines and cosines of place and time, two layers, the zero-initialized heads of HexPlane.

    Args:
        settings: sizes.
        bounds: lower and upper corner of the box that maps to [-1, 1], world units.
        generator: for the start of the layers.
        last: where the last frame lies on the network's axis of time, which ends at 1.
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
        """What to add at every time in [0, 1]."""
        low, high = self.bounds
        place = ((means - low) / (high - low) * 2 - 1).expand(len(times), -1, -1)
        time = (2 * self.last * times - 1)[:, None, None].expand(-1, len(means), 1)
        encoded = encode(torch.cat([place, time], -1), self.settings.frequencies)
        displacement: Displacement = self.heads(self.second, functional.relu(self.first(encoded)))
        return displacement

    def grid_parameters(self) -> list[nn.Parameter]:
        """None: everything is network."""
        return []

    def regularization_loss(self) -> Float[Tensor, ""]:
        """A network of this size has no regularizer: zero."""
        return self.bounds.new_zeros(())


def encode(values: Float[Tensor, "*b d"], frequencies: int) -> Float[Tensor, "*b e"]:
    """The values, and sines and cosines of pi times 1, 2, 4, ... of them (Mildenhall et al. 2020)."""
    octaves = 2.0 ** torch.arange(frequencies, dtype=values.dtype, device=values.device)
    angles = values[..., None, :] * (torch.pi * octaves)[:, None]
    return torch.cat([values, angles.sin().flatten(-2), angles.cos().flatten(-2)], -1)
