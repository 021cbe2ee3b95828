"""Shape of known views on the rays of the input camera, as the shape prior describes a subject."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn.functional import grid_sample

from dg4d_lib.cameras.orbit import RADIUS
from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.shape_prior.field import (
    ShapeField,
    bounded_logits,
    picture_mask,
    premultiplied,
    straight_color,
)
from dg4d_lib.shape_prior.frustum import BINS, FAR, NEAR, SIZE, TAN_HALF_FOV
from dg4d_lib.shape_prior.raymarch import CELL
from dg4d_lib.visual_hull.carve import Volume
from dg4d_lib.visual_hull.known import KnownView

SOFTNESS = 0.01  # world units: distance to the surface at which the log-odds of matter are 1


def known_field(views: Sequence[KnownView], volume: Volume, surface: InflatedSurface) -> ShapeField:
    """Return the shape of a subject on the rays of the input view.

    Args:
        views: of one moment, the input view first.
        volume: their shape; see `known_volume`.
        surface: of the volume, colored.
    """
    picture = premultiplied(views[0].cutout)
    logits, mask = _sampled(volume, cell_centers()) / SOFTNESS, picture_mask(picture)
    color, hidden = straight_color(picture), _nearest_colors(surface)
    return ShapeField(bounded_logits(logits, mask), color, hidden, mask, 0.0, generosity=0.0)


def cell_centers() -> Float[Tensor, "128 128 64 3"]:
    """Return the world places of the centers of the cells on the input camera's rays."""
    across = (2 * (torch.arange(SIZE) + 0.5) / SIZE - 1) * TAN_HALF_FOV
    distance = NEAR + (torch.arange(BINS) + 0.5) * (FAR - NEAR) / BINS
    x, y = across[None, :, None] * distance, -across[:, None, None] * distance
    return torch.stack(torch.broadcast_tensors(x, y, RADIUS - distance), -1)


def _nearest_colors(surface: InflatedSurface) -> Float[Tensor, "128 128 64 3"]:
    """Return for every cell the color of the nearest one that the surface passes."""
    x, y, z = surface.vertices.unbind(-1)
    distance = RADIUS - z
    column, row = ((side / (distance * TAN_HALF_FOV) + 1) * SIZE / 2 for side in (x, -y))
    depth = (distance - NEAR) / CELL
    cells = torch.stack([row, column, depth], -1).long()
    inside = ((cells >= 0) & (cells < torch.tensor([SIZE, SIZE, BINS]))).all(-1)
    place = tuple(cells[inside].T)
    colors = torch.zeros(SIZE, SIZE, BINS, 3)
    colors[place] = surface.colors[inside]
    empty = np.ones((SIZE, SIZE, BINS), bool)
    empty[place] = False
    sides = (2 * RADIUS * TAN_HALF_FOV / SIZE, 2 * RADIUS * TAN_HALF_FOV / SIZE, CELL)
    nearest = distance_transform_edt(empty, sampling=sides, return_distances=False, return_indices=True)
    return colors[tuple(torch.from_numpy(np.asarray(nearest)).long())]


def _sampled(volume: Volume, points: Float[Tensor, "r c d 3"]) -> Float[Tensor, "r c d"]:
    """Return the field of a volume at points; outside of its grid the lowest value."""
    values = torch.from_numpy(volume.values)
    places = (points - torch.from_numpy(volume.low)) / volume.step
    at = 2 * places / (torch.tensor(values.shape) - 1) - 1
    found = grid_sample(values[None, None], at.flip(-1)[None], align_corners=True, padding_mode="border")[0, 0]
    return torch.where((at.abs() <= 1).all(-1), found, values.min())
