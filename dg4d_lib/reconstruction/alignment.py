"""Azimuth alignment of a reconstruction with an image."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.images import resize_planes
from dg4d_lib.rasterizer.interface import Rasterizer

COARSE_DEG, FINE_DEG = 5.0, 0.5  # degrees; steps of the full search, and of the search around its best azimuth
SIZE = 128  # pixels of the compared images
BATCH = 12  # cameras per call; bounds the memory


def best_azimuth(gaussians: Gaussians, image: Float[Tensor, "h w 3"], rasterize: Rasterizer) -> float:
    """Return the azimuth, in degrees in [-180, 180), at which the render is closest to the image.

    Searches at elevation 0 and the default radius: all around in steps of 5 degrees, then around the best azimuth in
    steps of 0.5 degrees.

    Args:
        gaussians: one state.
        image: over white, in [0, 1], square.
        rasterize: rasterizer.
    """
    target = image.permute(2, 0, 1)[None].to(gaussians.means)
    target = resize_planes(target, (SIZE, SIZE))
    target = target[0].permute(1, 2, 0)
    coarse = [-180 + COARSE_DEG * i for i in range(round(360 / COARSE_DEG))]
    coarse_best = _nearest(gaussians, target, coarse, rasterize)
    steps = round(COARSE_DEG / FINE_DEG)
    best = _nearest(gaussians, target, [coarse_best + FINE_DEG * i for i in range(-steps, steps + 1)], rasterize)
    return (best + 180) % 360 - 180


@torch.no_grad()
def _nearest(
    gaussians: Gaussians, target: Float[Tensor, "h w 3"], azimuths_deg: Sequence[float], rasterize: Rasterizer
) -> float:
    """Return the azimuth with the smallest mean squared color error; the first of equal ones."""
    white = torch.ones(3, device=gaussians.means.device)
    camera = OrbitCamera(width=SIZE, height=SIZE)
    errors: list[float] = []
    for start in range(0, len(azimuths_deg), BATCH):
        cameras = [replace(camera, azimuth_deg=azimuth) for azimuth in azimuths_deg[start : start + BATCH]]
        colors = rasterize(gaussians, cameras, white).color
        errors += (colors - target).square().mean((1, 2, 3)).tolist()
    return azimuths_deg[errors.index(min(errors))]
