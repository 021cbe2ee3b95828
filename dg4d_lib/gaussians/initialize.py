"""How a cloud starts: a random blob (DreamGaussian), or points on a known surface."""

import math

import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.spherical_harmonics import rgb_to_sh

BLOB_OPACITY = 0.1
SURFACE_OPACITY = 0.9
NEIGHBORS = 3
SMALLEST = 1e-4  # world units; coincident points still get a size


def blob(count: int, radius: float, generator: torch.Generator) -> Gaussians:
    """Gray points uniform in a ball, as large as their three nearest neighbors are far (root mean square).

    Args:
        count: Gaussians.
        radius: of the ball, world units.
        generator: the source of the places.
    """
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    means = directions * radius * torch.rand(count, 1, generator=generator) ** (1 / 3)
    places = means.numpy()
    distances = torch.as_tensor(cKDTree(places).query(places, k=min(NEIGHBORS, count - 1) + 1)[0])[:, 1:]
    scales = distances.square().mean(-1).sqrt().clamp(min=SMALLEST).to(means)
    return isotropic(means, scales, torch.full((count, 3), 0.5), BLOB_OPACITY)


def on_surface(points: Float[Tensor, "n 3"], colors: Float[Tensor, "n 3"], area: float) -> Gaussians:
    """Round Gaussians that cover a surface evenly: scale sqrt(area / n), opacity 0.9.

    Args:
        points: evenly spread over the surface, world units.
        colors: there, in [0, 1].
        area: of the surface, world units squared.
    """
    scale = max(math.sqrt(area / len(points)), SMALLEST)
    return isotropic(points, points.new_full((len(points),), scale), colors, SURFACE_OPACITY)


def isotropic(
    means: Float[Tensor, "n 3"], scales: Float[Tensor, " n"], colors: Float[Tensor, "n 3"], opacity: float
) -> Gaussians:
    """Balls of one opacity."""
    count = len(means)
    return Gaussians(
        means.clone(),
        scales.log()[:, None].repeat(1, 3),
        means.new_tensor((1.0, 0.0, 0.0, 0.0)).repeat(count, 1),
        means.new_full((count,), math.log(opacity / (1 - opacity))),
        rgb_to_sh(colors),
    )
