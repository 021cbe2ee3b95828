"""Guidance priors: score rendered views that have no ground truth."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.inflation.surface import InflatedSurface


@dataclass(frozen=True)
class GuidanceView:
    """Camera and frame of a scored render.

    Attributes:
        camera: pose and image size.
        frame: index into the driving video; 0 in the static stage.
    """

    camera: OrbitCamera
    frame: int = 0


def check_views(views: Sequence[GuidanceView], frames: int) -> None:
    """Refuse views that cannot be rendered in one batch from the shapes of these frames.

    Raises:
        BadInput: no views, views of different sizes, or a frame that is not there.
    """
    if not views:
        raise BadInput("no views were requested from the prior; request at least one")
    sizes = sorted({(view.camera.height, view.camera.width) for view in views})
    if len(sizes) > 1:
        raise BadInput(f"views of one call must have one size; given {sizes}")
    for view in views:
        check_frame(view.frame, frames)


def check_frame(frame: int, frames: int) -> None:
    """Refuse a frame that does not exist."""
    if not 0 <= frame < frames:
        raise BadInput(f"frame {frame} was requested; there are {frames}, counted from 0")


@runtime_checkable
class GuidancePrior(Protocol):
    """Loss on rendered views."""

    @property
    def viewpoints(self) -> tuple[OrbitCamera, ...] | None:
        """Supported cameras (their image size is ignored); None: all."""

    @property
    def frames(self) -> tuple[int, ...] | None:
        """Supported frames; None: all."""

    def loss(
        self,
        images: Float[Tensor, "b h w 3"],
        alpha: Float[Tensor, "b h w 1"],
        views: Sequence[GuidanceView],
        progress: float,
        generator: torch.Generator,
    ) -> Float[Tensor, ""]:
        """Return the loss of these renders, averaged over images.

        Args:
            images: renders over white, in [0, 1].
            alpha: of the renders; ignored by priors of opaque images.
            views: one per image.
            progress: of the optimization, in [0, 1].
            generator: source of all randomness.
        """
        ...


@runtime_checkable
class SubjectShapes(Protocol):
    """Shapes of a subject, one per frame, from which a prior renders the expected views."""

    def surface(self, frame: int) -> InflatedSurface:
        """Return the closed, colored surface of a frame."""
        ...

    def clean(self, views: Sequence[GuidanceView]) -> tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 1"]]:
        """Return expected color over white and expected alpha of views of one size, in [0, 1]."""
        ...


@runtime_checkable
class RingPrior(Protocol):
    """Guidance prior that scores rings of cameras at one frame together."""

    @property
    def ring_size(self) -> int:
        """Number of consecutive views, at equal steps of azimuth all around; at least 1."""
        ...


def ring_size(prior: GuidancePrior) -> int:
    """Return the number of consecutive views that the prior scores together; 1 if it scores them separately."""
    return prior.ring_size if isinstance(prior, RingPrior) else 1
