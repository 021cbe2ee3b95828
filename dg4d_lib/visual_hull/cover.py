"""Matter behind every pixel of the input view, also where the silhouettes of other views exclude all of it.

Views that are drawn, or whose angles are a little wrong, carve thin parts away. What such a hull does not explain of an
exact silhouette is filled with the places that violate the others least (Landabaso, Pardas and Casas 2008, shape from
inconsistent silhouette).
"""

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.visual_hull.carve import TRUNCATION, Volume, margins_of
from dg4d_lib.visual_hull.known import KnownView, places_before

REACH = 0.08  # world units outside of the hull in which matter is searched


def covering(volume: Volume, view: KnownView, tolerance: float) -> Volume:
    """Return a hull with matter behind every pixel of a view.

    Args:
        volume: hull or columns, exact to `REACH` outside of them.
        view: whose silhouette is right.
        tolerance: by which a place may violate the silhouettes more than the best one behind its pixel, world units.
    """
    values, limit = torch.from_numpy(volume.values), TRUNCATION * volume.step
    near = values > -REACH
    points = torch.from_numpy(volume.low) + near.nonzero() * volume.step
    margins = values[near]
    pixel, count = _pixels(points, view.camera, volume.step)
    inside = margins_of([view], points) > 0
    best = torch.full((count,), -torch.inf).scatter_reduce(0, pixel[inside], margins[inside], "amax")
    empty = inside & (best[pixel] <= 0)
    filled = torch.where(empty, margins - best[pixel] + tolerance, -torch.inf)
    covered = values.clone()
    covered[near] = torch.maximum(margins, filled)
    return replace(volume, values=covered.clamp(-limit, limit).numpy())


def _pixels(points: Float[Tensor, "n 3"], camera: OrbitCamera, step: float) -> tuple[Int[Tensor, " n"], int]:
    """Return the pixels (row by row) about as wide as a cell that show points, and the number of all pixels."""
    size = max(1, round(step * camera.focal / camera.radius))
    side = -(-camera.width // size)
    at = (places_before(camera, points)[:, 1:] + 1) / 2 * camera.width / size
    column, row = at.long().clamp(0, side - 1).T
    return row * side + column, side**2
