"""The weights-free stand-in for a diffusion model: renders of surfaces inflated from the driving video.

The outline says nothing sure about depth. The best single picture of a view is then the average over what may be, so a
view is blurred along the direction in which depth shows: not at all from the input camera, most from the side.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera, world_to_camera
from dg4d_lib.errors import BadInput
from dg4d_lib.guidance.interface import View
from dg4d_lib.inflation.render import render_surface
from dg4d_lib.inflation.surface import InflatedSurface, inflate
from dg4d_lib.settings import GeometricPriorSettings

SHARPEST = 0.05  # pixels: narrower Gaussians are the identity in float32
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
        both = torch.cat([color * coverage + (1 - coverage), coverage], -1)
        if self._settings.depth_sigma:
            both = averaged_over_depth(both, cameras, self._settings.depth_sigma)
        return both[..., :3], both[..., 3:]


def averaged_over_depth(
    images: Float[Tensor, "b h w c"], cameras: Sequence[OrbitCamera], depth_sigma: float
) -> Float[Tensor, "b h w c"]:
    """The pictures averaged over shifts of the subject along the input camera's axis (the world's z).

    Args:
        images: one per camera.
        cameras: where they were taken; the shift is that of a point at the origin.
        depth_sigma: standard deviation of the shift, world units.
    """
    pixels = torch.tensor([depth_sigma * camera.focal / camera.radius for camera in cameras], dtype=torch.float64)
    shift = world_to_camera(cameras)[:, :2, 2].abs() * pixels[:, None]
    across, down = (_gaussian(shift[:, i], size).to(images) for i, size in ((0, images.shape[2]), (1, images.shape[1])))
    rows = torch.einsum("bij,bjlc->bilc", down, images)
    return torch.einsum("bkl,bilc->bikc", across, rows)


def _gaussian(sigmas: Float[Tensor, " b"], size: int) -> Float[Tensor, "b size size"]:
    """Rows of normalized weights; a sigma of zero is the identity."""
    places = torch.arange(size, dtype=sigmas.dtype)
    reach = (places[:, None] - places).square() / (2 * sigmas.clamp(min=SHARPEST)[:, None, None].square())
    weights = (-reach).exp()
    return weights / weights.sum(-1, keepdim=True)
