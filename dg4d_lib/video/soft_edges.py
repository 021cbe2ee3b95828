"""Foreground colors along a soft outline, freed from the background."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy import ndimage
from torch import Tensor

SOLID, CLEAR = 0.98, 0.02  # alpha from which a pixel is all subject, and up to which it is all background
BAND = 2 / 256  # reach of the colors around a mixed pixel, as a share of the longest side


def free_colors(picture: Float[Tensor, "h w 3"], alpha: Float[Tensor, "h w"]) -> Float[Tensor, "h w 4"]:
    """Return a cut-out with the given alpha whose mixed pixels have the color of the subject alone.

    A mixed pixel is `alpha * foreground + (1 - alpha) * background`: the background is extrapolated from the clear
    pixels nearby, and the rest is divided by alpha; the fainter alpha is, the more the color of the nearby solid pixels
    counts instead.
    """
    cutout = torch.cat([picture, alpha[..., None]], -1)
    visible = (alpha > 0).cpu().numpy()
    rows, columns = np.flatnonzero(visible.any(1)), np.flatnonzero(visible.any(0))
    if not len(rows):
        return cutout
    band = max(2, round(BAND * max(alpha.shape)))
    margin = 4 * band
    window = (
        slice(max(0, rows[0] - margin), rows[-1] + 1 + margin),
        slice(max(0, columns[0] - margin), columns[-1] + 1 + margin),
    )
    image, opacity = (each[window].cpu().numpy().astype(np.float64) for each in (picture, alpha))
    solid, clear = opacity >= SOLID, opacity <= CLEAR
    if not solid.any() or not clear.any():
        return cutout
    front, back = _extrapolate(image, solid, band), _extrapolate(image, clear, band)
    pure = (image - (1 - opacity[..., None]) * back) / np.maximum(opacity[..., None], CLEAR)
    color = np.where(solid[..., None], image, front + opacity[..., None] * (np.clip(pure, 0, 1) - front))
    cutout[window] = torch.from_numpy(np.dstack([color, opacity]).clip(0, 1)).to(cutout)
    return cutout


def _extrapolate(image: Float[ndarray, "h w 3"], source: Bool[ndarray, "h w"], band: int) -> Float[ndarray, "h w 3"]:
    """Extrapolate the source pixels' colors: a local mean near them, the nearest color farther away."""
    weight = ndimage.gaussian_filter(source.astype(np.float64), band)
    mean = ndimage.gaussian_filter(image * source[..., None], (band, band, 0)) / np.maximum(weight, 1e-9)[..., None]
    nearest = ndimage.distance_transform_edt(~source, return_distances=False, return_indices=True)
    return np.where((weight > 1e-3)[..., None], mean, image[nearest[0], nearest[1]])
