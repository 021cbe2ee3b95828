"""Mean of two guesses at the shapes of a subject: where they disagree, views are soft."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.guidance.interface import GuidanceView, SubjectShapes
from dg4d_lib.inflation.surface import InflatedSurface


class MixedShapes:
    """Shapes that are one of two, with known probabilities."""

    def __init__(self, first: SubjectShapes, second: SubjectShapes, share: float) -> None:
        """Store both.

        Args:
            first: its surfaces stand for both.
            second: the other shapes of the same frames.
            share: probability of the second, in [0, 1].
        """
        self._first, self._share = first, share
        self.second = second

    def surface(self, frame: int) -> InflatedSurface:
        """Return the surface that the first has at a frame.

        Raises:
            BadInput: there is no such frame.
        """
        return self._first.surface(frame)

    def clean(self, views: Sequence[GuidanceView]) -> tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 1"]]:
        """Return expected color over white and expected alpha of views of one size, in [0, 1].

        Raises:
            BadInput: no views, views of different sizes, or a frame that is not there.
        """
        (color, alpha), (other_color, other_alpha) = self._first.clean(views), self.second.clean(views)
        return torch.lerp(color, other_color, self._share), torch.lerp(alpha, other_alpha, self._share)
