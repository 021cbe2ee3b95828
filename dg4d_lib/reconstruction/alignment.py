"""From which side a reconstruction looks like a picture."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.images import resize_planes
from dg4d_lib.rasterizer.interface import Rasterizer

COARSE_DEG, FINE_DEG = 5.0, 0.5  # steps of the search all around, and of the one around the best
SIZE = 128  # pixels at which pictures are compared
AT_ONCE = 12  # cameras per call: bounds the memory that many Gaussians take


def best_azimuth(gaussians: Gaussians, picture: Float[Tensor, "h w 3"], rasterize: Rasterizer) -> float:
    """The azimuth, in degrees in [-180, 180), from which the cloud's color is nearest to the picture's.

    At elevation 0 and the method's radius; all around in steps of 5 degrees, then around the best in steps of half a
    degree.

    Args:
        gaussians: one state.
        picture: over white, in [0, 1], square.
        rasterize: draws.
    """
    target = picture.permute(2, 0, 1)[None].to(gaussians.means)
    target = resize_planes(target, (SIZE, SIZE))
    target = target[0].permute(1, 2, 0)
    coarse = [-180 + COARSE_DEG * i for i in range(round(360 / COARSE_DEG))]
    near = _nearest(gaussians, target, coarse, rasterize)
    steps = round(COARSE_DEG / FINE_DEG)
    best = _nearest(gaussians, target, [near + FINE_DEG * i for i in range(-steps, steps + 1)], rasterize)
    return (best + 180) % 360 - 180


@torch.no_grad()
def _nearest(
    gaussians: Gaussians, target: Float[Tensor, "h w 3"], azimuths_deg: Sequence[float], rasterize: Rasterizer
) -> float:
    """The azimuth with the least mean squared error of color; the first of equals."""
    white = torch.ones(3, device=gaussians.means.device)
    camera = OrbitCamera(width=SIZE, height=SIZE)
    errors: list[float] = []
    for start in range(0, len(azimuths_deg), AT_ONCE):
        cameras = [replace(camera, azimuth_deg=azimuth) for azimuth in azimuths_deg[start : start + AT_ONCE]]
        colors = rasterize(gaussians, cameras, white).color
        errors += (colors - target).square().mean((1, 2, 3)).tolist()
    return azimuths_deg[errors.index(min(errors))]
