"""Mean of several guesses at the shapes of a subject: where they disagree, views are soft."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.guidance.interface import GuidanceView, SubjectShapes
from dg4d_lib.inflation.surface import InflatedSurface


class MixedShapes:
    """Shapes that are one of several, with known probabilities."""

    def __init__(self, guesses: Sequence[SubjectShapes], shares: Sequence[float]) -> None:
        """Store the guesses.

        Args:
            guesses: shapes of the same frames; surfaces are taken from the first.
            shares: probability of each, sum 1.
        """
        self.guesses, self._shares = tuple(guesses), tuple(shares)

    def surface(self, frame: int) -> InflatedSurface:
        """Return the surface that the first guess has at a frame.

        Raises:
            BadInput: there is no such frame.
        """
        return self.guesses[0].surface(frame)

    def clean(self, views: Sequence[GuidanceView]) -> tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 1"]]:
        """Return expected color over white and expected alpha of views of one size, in [0, 1].

        Raises:
            BadInput: no views, views of different sizes, or a frame that is not there.
        """
        weighted = zip(self.guesses, self._shares, strict=True)
        mean = torch.stack([share * torch.cat(guess.clean(views), -1) for guess, share in weighted]).sum(0)
        return mean[..., :3], mean[..., 3:]
