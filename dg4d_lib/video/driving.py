"""Driving video: frames of the subject from the input view."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.images import over_background


@dataclass(frozen=True)
class DrivingVideo:
    """Cut-out frames of the subject.

    Attributes:
        frames: straight color in [0, 1], undefined where alpha is 0.
        alpha: opacity in [0, 1].
        fps: frames per second.
    """

    frames: Float[Tensor, "t h w 3"]
    alpha: Float[Tensor, "t h w 1"]
    fps: float

    def __len__(self) -> int:
        return self.frames.shape[0]

    @property
    def times(self) -> Float[Tensor, " t"]:
        """Timestamps of the frames in [0, 1]; the first is 0, the last 1."""
        return torch.linspace(0, 1, len(self), device=self.frames.device)

    def over(self, background: Float[Tensor, " 3"]) -> Float[Tensor, "t h w 3"]:
        """Composite the frames over one color."""
        return over_background(self.frames, self.alpha, background)
