"""What makes a driving video from one picture."""

from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.video.driving import DrivingVideo


@runtime_checkable
class VideoGenerator(Protocol):
    """A source of motion: procedural warps, or video diffusion."""

    def generate(self, subject: Float[Tensor, "h w 4"], generator: torch.Generator) -> DrivingVideo:
        """A video whose first frame shows the subject (straight alpha, in [0, 1])."""
        ...
