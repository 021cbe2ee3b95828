"""Shapes of a subject from a tracked surface."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from dg4d_lib.guidance.interface import GuidanceView, check_frame, check_views
from dg4d_lib.images import over_background
from dg4d_lib.inflation.render import render_surface
from dg4d_lib.inflation.surface import InflatedSurface


class MovedSurfaces:
    """Tracked surfaces, one per frame."""

    def __init__(self, surfaces: Sequence[InflatedSurface]) -> None:
        """Store the surfaces, one per frame."""
        self._surfaces = tuple(surfaces)

    def surface(self, frame: int) -> InflatedSurface:
        """Return the surface of a frame.

        Raises:
            BadInput: there is no such frame.
        """
        check_frame(frame, len(self._surfaces))
        return self._surfaces[frame]

    def clean(self, views: Sequence[GuidanceView]) -> tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 1"]]:
        """Return color over white and alpha of views of one size, in [0, 1].

        Raises:
            BadInput: no views, views of different sizes, or a frame that is not there.
        """
        check_views(views, len(self._surfaces))
        color, alpha = render_surface([self.surface(view.frame) for view in views], [view.camera for view in views])
        return over_background(color, alpha, 1.0), alpha
