"""Pinhole camera on a sphere around the origin, looking at the origin.

World axes: right-handed, y up, the object faces +z. Azimuth 0 is on +z, 90 on +x; positive elevation is above.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput

FOV_Y_DEG = 49.1  # degrees, on both axes; DreamGaussian's camera (Tang et al. 2024)
RADIUS = 2.0  # world units


@dataclass(frozen=True)
class OrbitCamera:
    """Pose, field of view and image size of an orbit camera.

    Attributes:
        elevation_deg: angle above the horizon, -90 to 90.
        azimuth_deg: counter-clockwise seen from above, 0 on +z, 90 on +x.
        radius: distance from the origin, world units, above 0.
        fov_y_deg: vertical field of view, between 0 and 180.
        width: image width, pixels, at least 1.
        height: image height, pixels, at least 1.

    Raises:
        BadInput: a value is out of range or not finite.
    """

    elevation_deg: float = 0.0
    azimuth_deg: float = 0.0
    radius: float = RADIUS
    fov_y_deg: float = FOV_Y_DEG
    width: int = 256
    height: int = 256

    def __post_init__(self) -> None:  # kernels trust these values: an image without pixels ends the process
        if not (math.isfinite(self.elevation_deg) and math.isfinite(self.azimuth_deg)):
            raise BadInput(f"the angles of a camera must be finite; given {self.elevation_deg}, {self.azimuth_deg}")
        if not (0 < self.radius < math.inf and 0 < self.fov_y_deg < 180):
            raise BadInput(
                "a camera must have a finite radius above 0 and a field of view between 0 and 180 degrees; given "
                f"{self.radius} and {self.fov_y_deg}"
            )
        if self.width < 1 or self.height < 1:
            raise BadInput(f"an image must have at least 1 x 1 pixels; given {self.width} x {self.height}")

    @property
    def focal(self) -> float:
        """Focal length in pixels, the same on both axes."""
        return 0.5 * self.height / math.tan(math.radians(self.fov_y_deg) / 2)

    @property
    def tan_half_fov(self) -> tuple[float, float]:
        """Tangents of half the horizontal and half the vertical field of view."""
        return 0.5 * self.width / self.focal, 0.5 * self.height / self.focal

    def position(self) -> Float[Tensor, " 3"]:
        """Return the camera center in world coordinates, float64."""
        e, a = math.radians(self.elevation_deg), math.radians(self.azimuth_deg)
        direction = (math.cos(e) * math.sin(a), math.sin(e), math.cos(e) * math.cos(a))
        return self.radius * torch.tensor(direction, dtype=torch.float64)

    def viewmat(self) -> Float[Tensor, "4 4"]:
        """Return the world-to-camera matrix, OpenCV axes (+x right, +y down, +z forward), float64."""
        e, a = math.radians(self.elevation_deg), math.radians(self.azimuth_deg)
        sin_e, cos_e, sin_a, cos_a = math.sin(e), math.cos(e), math.sin(a), math.cos(a)
        rows = (
            (cos_a, 0.0, -sin_a, 0.0),
            (sin_e * sin_a, -cos_e, sin_e * cos_a, 0.0),
            (-cos_e * sin_a, -sin_e, -cos_e * cos_a, self.radius),
            (0.0, 0.0, 0.0, 1.0),
        )
        return torch.tensor(rows, dtype=torch.float64)


def intrinsics(cameras: Sequence[OrbitCamera]) -> Float[Tensor, "b 3 3"]:
    """Return the intrinsic matrices, gsplat's `Ks`: focal lengths and principal points, pixels."""
    return torch.tensor(
        [
            ((camera.focal, 0, camera.width / 2), (0, camera.focal, camera.height / 2), (0, 0, 1))
            for camera in cameras
        ]
    )  # fmt: skip


def viewmats(cameras: Sequence[OrbitCamera]) -> Float[Tensor, "b 4 4"]:
    """Stack the world-to-camera matrices of several cameras, float64."""
    return torch.stack([camera.viewmat() for camera in cameras])
