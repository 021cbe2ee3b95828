"""Geometric prior without weights: renders of surfaces inflated from the driving video.

The outline does not determine depth. The best single picture of a view is then the average over the possible depths,
so a view is blurred along the direction in which depth shows: not at all from the input camera, most from the side.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Protocol, no_type_check, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera, viewmats
from dg4d_lib.guidance.interface import GuidanceView, check_frame, check_views
from dg4d_lib.images import over_background
from dg4d_lib.inflation.hints import NO_HINT, DepthHint
from dg4d_lib.inflation.render import render_surface
from dg4d_lib.inflation.surface import InflatedSurface, inflate, resample
from dg4d_lib.kernels.compiling import njit
from dg4d_lib.kernels.simd import INLINE, KERNEL
from dg4d_lib.kernels.workers import run_parallel
from dg4d_lib.settings import GeometricPriorSettings

SHARPEST = 0.05  # pixels: narrower Gaussians are the identity in float32
LARGE = 2  # times the surface's own resolution: larger pictures take one sample per pixel


@runtime_checkable
class Disparity(Protocol):
    """Estimator of relative inverse depth."""

    def disparity(self, cutout: Float[Tensor, "s s 4"]) -> Float[Tensor, "s s"]:
        """Return the inverse depth of a cut-out, larger where nearer, up to scale and offset."""
        ...


class InflatedSurfaces:
    """Inflated surface per frame, each built when first asked for."""

    def __init__(
        self,
        cutouts: Sequence[Float[Tensor, "h w 4"]],
        settings: GeometricPriorSettings,
        hint: DepthHint = NO_HINT,
        depth: Disparity | None = None,
    ) -> None:
        """Store the pictures.

        Args:
            cutouts: one per frame: square, straight alpha, color and alpha in [0, 1].
            settings: size of the surface, and uncertainty of its depth.
            hint: at the depth of the subject, by a user.
            depth: estimator of inverse depth, for the relief of every picture; None: none.
        """
        self._depth = depth
        self._cutouts = tuple(cutouts)
        self._settings, self._hint = settings, hint
        self._surfaces: dict[int, InflatedSurface] = {}

    def surface(self, frame: int) -> InflatedSurface:
        """Return the surface of a frame.

        Raises:
            BadInput: there is no such frame, or its picture shows no subject.
        """
        check_frame(frame, len(self._cutouts))
        if frame not in self._surfaces:
            size, disparity = self._settings.size, None
            if self._depth is not None:
                disparity = self._depth.disparity(resample(self._cutouts[frame], size))
            self._surfaces[frame] = inflate(
                self._cutouts[frame], size, self._hint, disparity, self._settings.depth_weight
            )
        return self._surfaces[frame]

    def clean(self, views: Sequence[GuidanceView]) -> tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 1"]]:
        """Return the expected views.

        Args:
            views: b cameras of one size, each with its frame.

        Returns:
            Colors over white and alpha, in [0, 1].

        Raises:
            BadInput: no views, views of different sizes, or a frame that is not there.
        """
        check_views(views, len(self._cutouts))
        surfaces = [self.surface(view.frame) for view in views]
        cameras = [view.camera for view in views]
        return surface_views(surfaces, cameras, self._settings.size, self._settings.depth_sigma)


def surface_views(
    surfaces: Sequence[InflatedSurface], cameras: Sequence[OrbitCamera], size: int, depth_sigma: float
) -> tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 1"]]:
    """Return color over white and alpha of surfaces whose depth is unsure, in [0, 1].

    Args:
        surfaces: one per camera.
        cameras: of one size.
        size: pixels of a side at which the surfaces were built.
        depth_sigma: see `averaged_over_depth`; 0: none.
    """
    fine = max(camera.height for camera in cameras) > LARGE * size
    color, alpha = render_surface(surfaces, cameras, supersample=1 if fine else 2)
    white = over_background(color, alpha, 1.0)
    both = torch.cat([white.movedim(-1, 1), alpha.movedim(-1, 1)], 1).movedim(1, -1)  # plane by plane
    if depth_sigma:
        both = averaged_over_depth(both, cameras, depth_sigma)
    return both[..., :3], both[..., 3:]


def averaged_over_depth(
    images: Float[Tensor, "b h w c"], cameras: Sequence[OrbitCamera], depth_sigma: float
) -> Float[Tensor, "b h w c"]:
    """Average pictures over shifts of the subject along the input camera's axis (the world's z).

    Args:
        images: one per camera.
        cameras: of the pictures; the shift is that of a point at the origin.
        depth_sigma: standard deviation of the shift, world units.
    """
    sigma = torch.tensor([depth_sigma * camera.focal / camera.radius for camera in cameras], dtype=torch.float64)
    shifts = (viewmats(cameras)[:, :2, 2].abs() * sigma[:, None]).tolist()
    planes = images.movedim(-1, 1).to("cpu", torch.float32).contiguous().numpy()
    blurred = np.empty_like(planes)
    weights = [[_gaussian(shift) for shift in pair] for pair in shifts]
    run_parallel([partial(_blur, *view) for view in zip(planes, *zip(*weights, strict=True), blurred, strict=True)])
    return torch.from_numpy(blurred).movedim(1, -1).to(images)


def _gaussian(sigma: float) -> Float32[np.ndarray, " taps"]:
    """Return the weights of the neighbors within five sigma, with sum 1; a sigma of zero is the identity."""
    sigma = max(sigma, SHARPEST)
    places = np.arange(-math.ceil(5 * sigma), math.ceil(5 * sigma) + 1)
    weights = np.exp(-np.square(places) / (2 * sigma**2))
    return (weights / weights.sum()).astype(np.float32)


@njit(**KERNEL)
@no_type_check
def _blur(planes, across, down, blurred):
    """Filter planes along both axes; where the filter leaves the picture, the weights inside count as all."""
    channels, height, width = planes.shape
    margin, reach = len(across) // 2, len(down) // 2
    line = np.zeros(width + 2 * margin, planes.dtype)
    middle = line[margin : margin + width]
    inside = np.zeros(width, planes.dtype)
    middle[:] = 1
    for place in range(len(across)):
        _add(across[place], line[place:], inside)
    for channel in range(channels):
        for row in range(height):
            middle[:] = 0
            whole = planes.dtype.type(0)
            for place in range(max(0, reach - row), min(len(down), height + reach - row)):
                _add(down[place], planes[channel, row + place - reach], middle)
                whole += down[place]
            found = blurred[channel, row]
            found[:] = 0
            for place in range(len(across)):
                _add(across[place], line[place:], found)
            for column in range(width):
                found[column] /= whole * inside[column]


@njit(**INLINE)
@no_type_check
def _add(weight, values, total):
    for i in range(len(total)):
        total[i] += weight * values[i]
