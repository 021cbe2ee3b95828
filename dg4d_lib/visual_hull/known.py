"""Known view: a cut-out picture of a subject and the camera that took it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.shape_prior.frustum import grid_places

CARVES = 0.5  # weight from which the outline of a view bounds the hull
SIDE_DEG = 50.0  # between views: less leaves the depth open, and the inflation bounds it


@dataclass(frozen=True)
class KnownView:
    """Picture from a known camera.

    Attributes:
        camera: pose and size of the picture.
        cutout: straight alpha, color and alpha in [0, 1].
        name: for messages.
        weight: reliability in [0, 1]; views below `CARVES` give colors, but no outline.
    """

    camera: OrbitCamera
    cutout: Float[Tensor, "h w 4"]
    name: str = ""
    weight: float = 1.0

    def at(self, elevation_deg: float, azimuth_deg: float) -> "KnownView":
        """Return the picture as taken from another direction."""
        return replace(self, camera=replace(self.camera, elevation_deg=elevation_deg, azimuth_deg=azimuth_deg))


def known_view(
    cutout: Float[Tensor, "h w 4"], azimuth_deg: float = 0.0, elevation_deg: float = 0.0, name: str = ""
) -> KnownView:
    """Return the view of a square picture from a direction; the default is that of the input camera.

    Raises:
        BadInput: the picture is not square.
    """
    height, width = cutout.shape[:2]
    if height != width:
        raise BadInput(f"a known view must be square; {name or 'the picture'} has {width} x {height} pixels")
    return KnownView(OrbitCamera(elevation_deg, azimuth_deg, width=width, height=height), cutout, name)


def angle_deg(one: OrbitCamera, other: OrbitCamera) -> float:
    """Return the angle between the directions of two cameras."""
    cosine = float(one.position() @ other.position()) / (one.radius * other.radius)
    return math.degrees(math.acos(max(-1.0, min(1.0, cosine))))


def places_before(camera: OrbitCamera, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Return the places of points before a square camera: depth, column and row, in [-1, 1]; see `grid_places`."""
    matrix = camera.viewmat().float()
    return grid_places(*(points @ matrix[:3, :3].T + matrix[:3, 3]).T)


def shows_sides(cameras: Sequence[OrbitCamera]) -> bool:
    """Return True if two cameras differ by `SIDE_DEG` or more, counting opposite directions as equal."""
    pairs = [(one, other) for number, one in enumerate(cameras) for other in cameras[:number]]
    return any(SIDE_DEG <= angle_deg(one, other) <= 180 - SIDE_DEG for one, other in pairs)
