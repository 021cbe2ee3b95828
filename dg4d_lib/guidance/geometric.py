"""The weights-free stand-in for a diffusion model: renders of surfaces inflated from the driving video."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.guidance.interface import View
from dg4d_lib.inflation.render import render_surface
from dg4d_lib.inflation.surface import InflatedSurface, inflate
from dg4d_lib.settings import GeometricPriorSettings

LARGE = 2  # times the surface's own resolution: larger pictures take one sample per pixel


class InflatedSurfaces:
    """A surface per frame, each built when it is first asked for."""

    def __init__(self, cutouts: Sequence[Float[Tensor, "h w 4"]], settings: GeometricPriorSettings) -> None:
        """Remember the pictures.

        Args:
            cutouts: one per frame: square, straight alpha, color and alpha in [0, 1].
            settings: at how many pixels to build, and how far the subject is turned.
        """
        self._cutouts = tuple(cutouts)
        self._settings = settings
        self._surfaces: dict[int, InflatedSurface] = {}

    def surface(self, frame: int) -> InflatedSurface:
        """The surface of a frame.

        Raises:
            BadInput: there is no such frame, or its picture shows no subject.
        """
        if not 0 <= frame < len(self._cutouts):
            raise BadInput(f"frame {frame} was asked for; there are {len(self._cutouts)}, counted from 0")
        if frame not in self._surfaces:
            self._surfaces[frame] = inflate(self._cutouts[frame], self._settings.size, self._settings.turn_deg)
        return self._surfaces[frame]

    def clean(self, views: Sequence[View]) -> tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 1"]]:
        """The pictures that the prior believes in.

        Args:
            views: b cameras of one size, each with its frame.

        Returns:
            Colors over white and coverage, in [0, 1].

        Raises:
            BadInput: no views, views of different sizes, or a frame that is not there.
        """
        if not views:
            raise BadInput("the prior was asked for no view at all; ask for at least one")
        surfaces = [self.surface(view.frame) for view in views]
        cameras = [view.camera for view in views]
        fine = max(camera.height for camera in cameras) > LARGE * self._settings.size
        color, coverage = render_surface(surfaces, cameras, supersample=1 if fine else 2)
        return color * coverage + (1 - coverage), coverage
