"""Sets of viewpoints: random ones for score distillation, fixed ones for baking and inspection."""

import math
from dataclasses import replace

import torch

from dg4d_lib.cameras.orbit import OrbitCamera

BAKING_ELEVATIONS_DEG = (0.0, -45.0, 45.0)
POLE_DEG = 89.9  # a camera exactly on the pole has no up


def random_orbit(
    count: int,
    size: int,
    *,
    elevation_deg: tuple[float, float],
    radius: tuple[float, float],
    generator: torch.Generator,
    ring: int = 1,
) -> list[OrbitCamera]:
    """Cameras all around: azimuth uniform in [-180, 180), elevation and radius uniform in the given ranges.

    With `ring` above 1, that many cameras at a time differ only in azimuth, by equal steps around the object.
    """
    u = torch.rand(math.ceil(count / ring), 3, generator=generator, dtype=torch.float64).tolist()
    (low_e, high_e), (low_r, high_r) = elevation_deg, radius
    firsts = [
        OrbitCamera(low_e + (high_e - low_e) * e, -180 + 360 * a, low_r + (high_r - low_r) * r, width=size, height=size)
        for e, a, r in u
    ]
    return [camera for first in firsts for camera in turntable(ring, first)][:count]


def turntable(count: int, camera: OrbitCamera) -> list[OrbitCamera]:
    """`count` cameras at equal steps of azimuth, starting at the given one's."""
    return [replace(camera, azimuth_deg=camera.azimuth_deg + 360 * i / count) for i in range(count)]


def baking_views(size: int) -> list[OrbitCamera]:
    """The 26 views of color back-projection: three rings of eight azimuths and the two poles."""
    rings = [
        OrbitCamera(elevation, 45.0 * i, width=size, height=size)
        for elevation in BAKING_ELEVATIONS_DEG
        for i in range(8)
    ]
    return [*rings, *(OrbitCamera(pole, width=size, height=size) for pole in (POLE_DEG, -POLE_DEG))]
