"""Mean of two guesses at the shapes of a subject: where they disagree, views are soft."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.guidance.interface import GuidanceView, SubjectShapes
from dg4d_lib.images import resize
from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.metrics.image import iou

OUTLINE_SIZE = 128  # pixels of a side


class MixedShapes:
    """Shapes that are one of two, with known probabilities."""

    def __init__(self, first: SubjectShapes, second: SubjectShapes, shares: Sequence[float]) -> None:
        """Store both.

        Args:
            first: its surfaces stand for both.
            second: the other shapes of the same frames.
            shares: probability of the second at every frame, in [0, 1].
        """
        self._first, self._shares = first, shares
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
        share = color.new_tensor([self._shares[view.frame] for view in views])[:, None, None, None]
        return torch.lerp(color, other_color, share), torch.lerp(alpha, other_alpha, share)


def outline_overlaps(shapes: SubjectShapes, cutouts: Sequence[Float[Tensor, "h w 4"]]) -> list[float]:
    """Return the IoU of the outline in every picture and that of its shape from the input camera.

    Args:
        shapes: of all frames.
        cutouts: square pictures of the frames, straight alpha.
    """
    camera, overlaps = OrbitCamera(width=OUTLINE_SIZE, height=OUTLINE_SIZE), []
    for frame, cutout in enumerate(cutouts):
        _, alpha = shapes.clean([GuidanceView(camera, frame)])
        overlaps.append(float(iou(alpha, resize(cutout[None, ..., 3:], (OUTLINE_SIZE, OUTLINE_SIZE)))))
    return overlaps
