"""Initialization of clouds: random ball (DreamGaussian), or points on a surface."""

import math

import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.spherical_harmonics import rgb_to_sh

BLOB_OPACITY = 0.1  # initial opacity (DreamGaussian)
SURFACE_OPACITY = 0.9  # ours: the surface is known
NEIGHBORS = 3  # whose distances give the scale (3DGS)
MIN_SCALE = 1e-4  # world units, for coincident points


def blob(count: int, radius: float, generator: torch.Generator) -> Gaussians:
    """Return gray Gaussians, uniform in a ball, scaled by the RMS distance of their three nearest neighbors.

    Args:
        count: number of Gaussians, at least 2.
        radius: of the ball, world units.
        generator: draws the means.
    """
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    means = directions * radius * torch.rand(count, 1, generator=generator) ** (1 / 3)
    points = means.numpy()
    distances = torch.as_tensor(cKDTree(points).query(points, k=min(NEIGHBORS, count - 1) + 1)[0])[:, 1:]
    scales = distances.square().mean(-1).sqrt().clamp(min=MIN_SCALE).to(means)
    return isotropic(means, scales, torch.full((count, 3), 0.5), BLOB_OPACITY)


def on_surface(points: Float[Tensor, "n 3"], colors: Float[Tensor, "n 3"], area: float) -> Gaussians:
    """Return isotropic Gaussians on a surface, of scale sqrt(area / n) and opacity 0.9.

    Args:
        points: uniform samples of the surface, world units.
        colors: at the points, in [0, 1].
        area: of the surface, world units squared.
    """
    scale = max(math.sqrt(area / len(points)), MIN_SCALE)
    return isotropic(points, points.new_full((len(points),), scale), colors, SURFACE_OPACITY)


def isotropic(
    means: Float[Tensor, "n 3"], scales: Float[Tensor, " n"], colors: Float[Tensor, "n 3"], opacity: float
) -> Gaussians:
    """Return isotropic Gaussians of one opacity."""
    count = len(means)
    return Gaussians(
        means.clone(),
        scales.log()[:, None].repeat(1, 3),
        means.new_tensor((1.0, 0.0, 0.0, 0.0)).repeat(count, 1),
        means.new_full((count,), math.log(opacity / (1 - opacity))),
        rgb_to_sh(colors),
    )
