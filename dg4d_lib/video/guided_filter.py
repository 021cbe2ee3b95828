"""Guided filter with a color guide (He, Sun and Tang 2013), with coefficients at reduced size (He and Sun 2015)."""

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy import ndimage
from torch import Tensor

from dg4d_lib.images import resize_planes


def guide_to_edges(
    values: Float[ndarray, "h w"],
    guide: Float[ndarray, "h w 3"],
    large: Float[Tensor, "h2 w2 3"],
    radius: int,
    eps: float,
) -> Float[Tensor, "h2 w2"]:
    """Smooth a map within the color edges of a guide, at the size of a larger version of the guide.

    Args:
        values: map, for example of a probability.
        guide: colors in [0, 1].
        large: the guide at full resolution.
        radius: of the windows, pixels of `guide`.
        eps: color variance below which a window counts as flat.
    """
    slopes, offsets = _coefficients(values.astype(np.float64), guide.astype(np.float64), radius, eps)
    planes = torch.from_numpy(np.dstack([slopes, offsets])).to(large).permute(2, 0, 1)[None]
    full = resize_planes(planes, large.shape[:2])[0].permute(1, 2, 0)
    return (full[..., :3] * large).sum(-1) + full[..., 3]


def _coefficients(
    values: Float[ndarray, "h w"], guide: Float[ndarray, "h w 3"], radius: int, eps: float
) -> tuple[Float[ndarray, "h w 3"], Float[ndarray, "h w"]]:
    """Return slopes and offsets of the linear models `slope . color + offset`, averaged over all windows of a pixel."""

    def mean(field: ndarray) -> ndarray:
        size = (2 * radius + 1, 2 * radius + 1) + (0,) * (field.ndim - 2)
        return np.asarray(ndimage.uniform_filter(field, size, mode="nearest"))

    colors, level = mean(guide), mean(values)
    covariance = mean(guide * values[..., None]) - colors * level[..., None]
    products = mean(guide[..., :, None] * guide[..., None, :]) - colors[..., :, None] * colors[..., None, :]
    slopes = np.linalg.solve(products + eps * np.eye(3), covariance[..., None])[..., 0]
    return mean(slopes), mean(level - (slopes * colors).sum(-1))
