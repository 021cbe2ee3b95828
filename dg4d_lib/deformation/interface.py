"""Interface of deformation models: additive displacements of raw Gaussian parameters at given times."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor, nn

from dg4d_lib.gaussians.cloud import Gaussians


@dataclass(frozen=True)
class Displacement:
    """Offsets of the raw parameters, one entry per time t; zero is the identity.

    Attributes:
        means: offset, world units.
        log_scales: offset before the exponential.
        quats: offset before normalization.
    """

    means: Float[Tensor, "t n 3"]
    log_scales: Float[Tensor, "t n 3"]
    quats: Float[Tensor, "t n 4"]

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """Return the cloud at every time; means, scales and quaternions get a leading t axis."""
        return Gaussians(
            gaussians.means + self.means,
            gaussians.log_scales + self.log_scales,
            gaussians.quats + self.quats,
            gaussians.opacity_logits,
            gaussians.harmonics,
        )


@runtime_checkable
class Deformation(Protocol):
    """Deformation model: HexPlane, MLP or frame-wise table."""

    def displace(self, means: Float[Tensor, "n 3"], times: Float[Tensor, " t"]) -> Displacement:
        """Return the displacements of Gaussians at these canonical means, at times in [0, 1] (first to last frame)."""
        ...

    def parameters(self) -> Iterator[nn.Parameter]:
        """Return all trainable parameters."""
        ...

    def grid_parameters(self) -> list[nn.Parameter]:
        """Return the parameters that use `plane_lr` (planes and tables); the others use `network_lr`."""
        ...

    def length_parameters(self) -> list[nn.Parameter]:
        """Return the parameters that carry the unit of length, whose learning rate `length_scale` multiplies."""
        ...

    def regularization_loss(self) -> Float[Tensor, ""]:
        """Return the weighted sum of the model's regularizers; zero if none is enabled."""
        ...
