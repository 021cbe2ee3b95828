"""Sets of viewpoints: random orbits for score distillation, fixed sets for baking and turntables."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.cameras.orbit import FOV_Y_DEG, RADIUS, OrbitCamera

BAKING_ELEVATIONS_DEG = (0.0, -45.0, 45.0)
PLASTIC = 1.324717957244746  # real root of x^3 = x + 1
SHOWN, MARGIN = 0.999, 0.06  # share of the points that widened pictures hold, and their borders, in half sides
PROBES = 24  # cameras that are looked through for it, at most
NEAREST = 0.5  # depth that nearer points count as, world units
POLE_DEG = 89.9  # elevation of the polar views; at exactly 90 the up vector is undefined


def random_orbit(
    count: int,
    size: int,
    *,
    elevation_deg: tuple[float, float],
    radius: tuple[float, float],
    generator: torch.Generator,
    ring: int = 1,
) -> list[OrbitCamera]:
    """Sample cameras: azimuth uniform in [-180, 180), elevation and radius uniform in the given ranges.

    Args:
        count: number of cameras.
        size: image width and height, pixels.
        elevation_deg: lowest and highest elevation.
        radius: smallest and largest distance from the origin, world units.
        generator: random numbers, on the CPU.
        ring: cameras per ring; those of a ring differ only in azimuth, by equal steps around the object.
    """
    u = torch.rand(math.ceil(count / ring), 3, generator=generator, dtype=torch.float64).tolist()
    (low_e, high_e), (low_r, high_r) = elevation_deg, radius
    firsts = [
        OrbitCamera(low_e + (high_e - low_e) * e, -180 + 360 * a, low_r + (high_r - low_r) * r, width=size, height=size)
        for e, a, r in u
    ]
    return [camera for first in firsts for camera in turntable(ring, first)][:count]


def spread_orbit(
    count: int, *, elevation_deg: tuple[float, float], radius: tuple[float, float]
) -> tuple[OrbitCamera, ...]:
    """Return cameras that cover the ranges of `random_orbit` evenly.

    Azimuths are at equal steps; elevations and radii follow the additive recurrence of the plastic number, which is
    even in both together (Roberts 2018).
    """
    (low_e, high_e), (low_r, high_r) = elevation_deg, radius
    return tuple(
        OrbitCamera(
            low_e + (high_e - low_e) * ((0.5 + i / PLASTIC) % 1),
            -180 + 360 * (i + 0.5) / count,
            low_r + (high_r - low_r) * ((0.5 + i / PLASTIC**2) % 1),
        )
        for i in range(count)
    )


def turntable(count: int, camera: OrbitCamera) -> list[OrbitCamera]:
    """Return `count` copies of a camera at equal steps of azimuth, the given azimuth first."""
    return [replace(camera, azimuth_deg=camera.azimuth_deg + 360 * i / count) for i in range(count)]


def widened(cameras: Sequence[OrbitCamera], points: Float[Tensor, "t p 3"]) -> list[OrbitCamera]:
    """Return the cameras with one field of view: the least from theirs on that shows each of them nearly all points.

    What comes nearer to a camera than the input view saw it may not fit into the picture.

    Args:
        cameras: with square pictures, all of one field of view. Of many, some are looked through.
        points: at every frame, world units; a few strays among those of a frame (`SHOWN`) are not waited for.
    """
    widest = max(camera.tan_half_fov[1] for camera in cameras)
    for camera in cameras[:: -(-len(cameras) // PROBES)] if points.numel() else ():
        view = camera.viewmat().to(points.device)
        seen = points.double() @ view[:3, :3].T + view[:3, 3]
        widest = max(widest, _shown_tangent(seen[..., :2].abs().amax(-1) / seen[..., 2].clamp_min(NEAREST)))
    fov_y_deg = _fov_deg(widest)
    return [replace(camera, fov_y_deg=max(fov_y_deg, camera.fov_y_deg)) for camera in cameras]


def whole_fov_y_deg(points: Float[Tensor, "t p 3"]) -> float:
    """Return the field of view of square pictures that show nearly all points, from all sides at the usual distance.

    It is at least that of the input camera. As in `widened`, a few strays among the points of a frame are not shown.

    Args:
        points: at every frame, world units.
    """
    if not points.numel():
        return FOV_Y_DEG
    reach = points.double().norm(dim=-1)
    # over all cameras, a point is farthest from the middle of the picture where the line of sight touches its sphere
    tangents = reach / (RADIUS**2 - reach.square()).clamp_min(NEAREST**2).sqrt()
    return max(FOV_Y_DEG, _fov_deg(_shown_tangent(tangents)))


def _shown_tangent(tangents: Float[Tensor, "t p"]) -> float:
    """Return the tangent of half a field of view that holds nearly all points of every frame, and a margin."""
    of_frames = np.quantile(tangents.cpu().numpy(), SHOWN, axis=1)  # torch.quantile sorts, which is slower
    return float(of_frames.max()) * (1 + MARGIN)


def _fov_deg(tangent: float) -> float:
    return math.degrees(2 * math.atan(tangent))


def baking_views(size: int) -> list[OrbitCamera]:
    """Return the 26 views of texture baking: three rings of eight azimuths and the two poles."""
    rings = [
        OrbitCamera(elevation, 45.0 * i, width=size, height=size)
        for elevation in BAKING_ELEVATIONS_DEG
        for i in range(8)
    ]
    return [*rings, *(OrbitCamera(pole, width=size, height=size) for pole in (POLE_DEG, -POLE_DEG))]
