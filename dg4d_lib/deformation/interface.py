"""What moves Gaussians: a displacement at a time, always something to add."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor, nn

from dg4d_lib.gaussians.cloud import Gaussians


@dataclass(frozen=True)
class Displacement:
    """Added to raw parameters; zeros is the identity. The leading t is one entry per time.

    Attributes:
        means: world units.
        log_scales: added before the exponential.
        quats: added before normalization.
    """

    means: Float[Tensor, "t n 3"]
    log_scales: Float[Tensor, "t n 3"]
    quats: Float[Tensor, "t n 4"]

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """The cloud at every time: means, scales and rotations get a leading t; opacity and color stay."""
        return Gaussians(
            gaussians.means + self.means,
            gaussians.log_scales + self.log_scales,
            gaussians.quats + self.quats,
            gaussians.opacity_logits,
            gaussians.harmonics,
        )


@runtime_checkable
class Deformation(Protocol):
    """A motion model: HexPlane, MLP, frame-wise."""

    def displace(self, means: Float[Tensor, "n 3"], times: Float[Tensor, " t"]) -> Displacement:
        """What to add to Gaussians at these canonical means, at every time in [0, 1] (0 first frame, 1 last)."""
        ...

    def parameters(self) -> Iterator[nn.Parameter]:
        """Everything that is fitted."""
        ...

    def grid_parameters(self) -> list[nn.Parameter]:
        """Those of the parameters that learn fast: tables and planes, not networks."""
        ...

    def regularization_loss(self) -> Float[Tensor, ""]:
        """The weighted sum of the model's own regularizers; zero where none is switched on."""
        ...
