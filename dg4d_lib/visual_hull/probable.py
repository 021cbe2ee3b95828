"""Part of a hull that a shape prior finds probable.

Few silhouettes allow matter that is not there, such as between the four legs of an animal. A prior that predicts the
shape behind each picture tells which: a cell stays where it is probable by the mean over all views, or is nearly the
most probable one behind some pixel, since something must be there.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter
from torch import Tensor
from torch.nn.functional import grid_sample

from dg4d_lib.shape_prior.frustum import SIZE
from dg4d_lib.visual_hull.carve import TRUNCATION, Volume
from dg4d_lib.visual_hull.known import KnownView, places_before

NEARLY = 0.3  # log-odds by which a cell that stays may be less probable than the best one behind its pixel
SMOOTH = 1.0  # cells: standard deviation of the filter over log-odds

# Occupancy log-odds at every row, column and depth (`dg4d_lib.shape_prior.frustum`) in front of a cut-out's camera.
Predict = Callable[[Float[Tensor, "h w 4"]], Float[Tensor, "128 128 64"]]


def probable(volume: Volume, views: Sequence[KnownView], predict: Predict) -> Volume:
    """Return the probable part of a hull.

    Args:
        volume: hull of the views.
        views: of one frame; their weights count.
        predict: tells the shape behind each of their pictures.
    """
    values = torch.from_numpy(volume.values)
    near = values > -TRUNCATION * volume.step
    points = torch.from_numpy(volume.low) + near.nonzero() * volume.step
    mean, pixels = torch.zeros(len(points)), []
    for view in views:
        logits, pixel = _seen(points, view, predict(view.cutout))
        mean += view.weight * logits
        pixels.append(pixel)
    mean = _smoothed(mean / sum(view.weight for view in views), near)
    inside, gap = values[near] > 0, torch.full_like(mean, torch.inf)
    for pixel in pixels:
        best = torch.full((SIZE**2,), -torch.inf).scatter_reduce(0, pixel[inside], mean[inside], "amax")
        gap = torch.minimum(gap, best[pixel] - mean)
    kept = torch.maximum(mean, 2 * (NEARLY - gap)) * volume.step  # the surface is where this is 0
    bounded = values.clone()
    bounded[near] = torch.minimum(values[near], kept.clamp(min=-TRUNCATION * volume.step))
    return replace(volume, values=bounded.numpy())


def _seen(
    points: Float[Tensor, "n 3"], view: KnownView, logits: Float[Tensor, "128 128 64"]
) -> tuple[Float[Tensor, " n"], Int[Tensor, " n"]]:
    """Return the log-odds of points in front of the camera of a view, and the pixels (row by row) that show them."""
    at = places_before(view.camera, points)
    found = grid_sample(logits[None, None], at[None, None, None], align_corners=False, padding_mode="border")[
        0, 0, 0, 0
    ]
    column, row = ((at[:, 1:] + 1) * SIZE / 2).long().clamp(0, SIZE - 1).T
    return found, row * SIZE + column


def _smoothed(values: Float[Tensor, " n"], places: Bool[Tensor, "x y z"]) -> Float[Tensor, " n"]:
    """Return values at some places of a grid, averaged with those of neighboring places."""
    inside = places.numpy()
    total, share = np.zeros(inside.shape, np.float32), inside.astype(np.float32)
    total[inside] = values.numpy()
    total, share = (gaussian_filter(grid, SMOOTH) for grid in (total, share))
    return torch.from_numpy(total[inside] / share[inside])
