"""What makes the pictures of a moving textured mesh better; the texture then follows them."""

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor


@runtime_checkable
class Refiner(Protocol):
    """A video in, a better video out."""

    def refine(self, video: Float[Tensor, "t h w 3"]) -> Float[Tensor, "t h w 3"]:
        """The same moments from the same viewpoints, in [0, 1]."""
        ...


class Identity:
    """Leaves the video as it is; a texture refined towards it does not change."""

    def refine(self, video: Float[Tensor, "t h w 3"]) -> Float[Tensor, "t h w 3"]:
        """The video itself."""
        return video
