"""What judges pictures that nobody took."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.inflation.surface import InflatedSurface


@dataclass(frozen=True)
class GuidanceView:
    """Where and when a picture is judged.

    Attributes:
        camera: the pose and the size of the picture.
        frame: which frame of the driving video, 0 for the static stage.
    """

    camera: OrbitCamera
    frame: int = 0


@runtime_checkable
class GuidancePrior(Protocol):
    """One number to lower."""

    @property
    def viewpoints(self) -> tuple[OrbitCamera, ...] | None:
        """The only cameras it can judge (their pixels do not matter); None is all of them."""

    @property
    def frames(self) -> tuple[int, ...] | None:
        """The only frames it can judge; None is all of them."""

    def loss(
        self,
        images: Float[Tensor, "b h w 3"],
        coverage: Float[Tensor, "b h w 1"],
        views: Sequence[GuidanceView],
        progress: float,
        generator: torch.Generator,
    ) -> Float[Tensor, ""]:
        """How unlikely these renders are, divided by their number.

        Args:
            images: renders over white, in [0, 1].
            coverage: their alpha; priors that only know pictures ignore it.
            views: one per image.
            progress: share of the optimization that is done, in [0, 1].
            generator: the source of all randomness.
        """
        ...


class SubjectShapes(Protocol):
    """Shapes of a subject, one per frame, from which a prior draws the views that it expects."""

    def surface(self, frame: int) -> InflatedSurface:
        """Return the closed, colored surface of a frame."""
        ...

    def clean(self, views: Sequence[GuidanceView]) -> tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 1"]]:
        """Return expected color over white and expected alpha of views of one size, in [0, 1]."""
        ...


@runtime_checkable
class RingPrior(Protocol):
    """What a prior has beside `GuidancePrior` if it judges several cameras of a moment together.

    Attributes:
        ring: how many; consecutive views, at equal steps of azimuth all around.
    """

    @property
    def ring(self) -> int:
        """At least 1."""
        ...


def ring_size(prior: GuidancePrior) -> int:
    """How many consecutive views the prior judges together; 1 if it judges each for itself."""
    return prior.ring if isinstance(prior, RingPrior) else 1
