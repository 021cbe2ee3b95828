"""Alpha and foreground colors along a soft outline, freed from the background."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy import ndimage
from torch import Tensor

SOLID, CLEAR = 0.98, 0.02  # alpha from which a pixel is all subject, and up to which it is all background
FAINT = 1e-3  # alpha below which a color cannot be freed
TELLING_COLORS = 0.04  # squared difference of two colors in the unit cube from which they determine alpha reliably
BAND = 2 / 256  # reach of the colors around a mixed pixel, as a share of the longest side


def free_colors(picture: Float[Tensor, "h w 3"], alpha: Float[Tensor, "h w"]) -> Float[Tensor, "h w 4"]:
    """Return a cut-out with the given alpha whose mixed pixels have the color of the subject alone.

    A mixed pixel is `alpha * foreground + (1 - alpha) * background`: the background is extrapolated from the clear
    pixels nearby, and the rest is divided by alpha; the fainter alpha is, the more the color of the nearby solid pixels
    counts instead.
    """
    cutout = torch.cat([picture, alpha[..., None]], -1)
    visible = (alpha > 0).cpu().numpy()
    if not visible.any():
        return cutout
    band = max(2, round(BAND * max(alpha.shape)))
    window = _window(visible, 4 * band)
    image, opacity = (each[window].cpu().numpy().astype(np.float64) for each in (picture, alpha))
    solid, clear = opacity >= SOLID, opacity <= CLEAR
    if not solid.any() or not clear.any():
        return cutout
    front, back = _extrapolate(image, solid, band), _extrapolate(image, clear, band)
    cutout[window] = _freed(image, opacity, front, back, solid, cutout)
    return cutout


def unmix(picture: Float[Tensor, "h w 3"], mask: Bool[ndarray, "h w"], band: int) -> Float[Tensor, "h w 4"]:
    """Estimate alpha and foreground color in a band along the outline of a mask.

    A pixel there mixes the colors of the nearby subject and the nearby background: alpha is its position on the line
    between these two colors, and the foreground color is the pixel without the background's part.

    Args:
        picture: in front of a backdrop that is smooth near the outline.
        mask: of the subject.
        band: half of the width of the band, pixels.
    """
    cutout = torch.cat([picture, torch.zeros_like(picture[..., :1])], -1)
    if mask.any():
        window = _window(mask, 4 * band)
        cutout[window] = _unmix(picture[window], mask[window], band)
    return cutout


def _window(mask: Bool[ndarray, "h w"], margin: int) -> tuple[slice, slice]:
    """Return the bounding box of a mask with a margin."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return (
        slice(max(0, rows[0] - margin), rows[-1] + 1 + margin),
        slice(max(0, columns[0] - margin), columns[-1] + 1 + margin),
    )


def _unmix(picture: Float[Tensor, "h w 3"], mask: Bool[ndarray, "h w"], band: int) -> Float[Tensor, "h w 4"]:
    image = picture.cpu().numpy().astype(np.float64)
    inside, outside = ndimage.distance_transform_edt(mask), ndimage.distance_transform_edt(~mask)
    core = mask & (inside > np.minimum(band, 0.75 * ndimage.maximum_filter(inside, 2 * band + 1)))
    away = outside > band
    if not core.any() or not away.any():
        return torch.cat([picture, torch.from_numpy(mask).to(picture)[..., None]], -1)
    front, back = _extrapolate(image, core, band), _extrapolate(image, away, band)
    line = front - back
    length = (line**2).sum(-1)
    mixed = ((image - back) * line).sum(-1) / np.maximum(length, 1e-6)
    geometric = ndimage.gaussian_filter(mask.astype(np.float64), 0.5 * band)
    trust = np.clip(length / TELLING_COLORS, 0, 1)
    alpha = np.clip((trust * mixed + (1 - trust) * geometric - 0.04) / 0.92, 0, 1)
    alpha = np.where(core, 1.0, np.where(away, 0.0, alpha))
    return _freed(image, alpha, front, back, core, picture)


def _freed(
    image: Float[ndarray, "h w 3"],
    alpha: Float[ndarray, "h w"],
    front: Float[ndarray, "h w 3"],
    back: Float[ndarray, "h w 3"],
    solid: Bool[ndarray, "h w"],
    like: Tensor,
) -> Float[Tensor, "h w 4"]:
    """Return a cut-out whose mixed pixels are without the background's part."""
    opacity = alpha[..., None]
    pure = (image - (1 - opacity) * back) / np.maximum(opacity, FAINT)
    color = np.where(solid[..., None], image, front + opacity * (np.clip(pure, 0, 1) - front))
    return torch.from_numpy(np.dstack([color, alpha]).clip(0, 1)).to(like)


def _extrapolate(image: Float[ndarray, "h w 3"], source: Bool[ndarray, "h w"], band: int) -> Float[ndarray, "h w 3"]:
    """Extrapolate the source pixels' colors: a local mean near them, the nearest color farther away."""
    weight = ndimage.gaussian_filter(source.astype(np.float64), band)
    mean = ndimage.gaussian_filter(image * source[..., None], (band, band, 0)) / np.maximum(weight, 1e-9)[..., None]
    nearest = ndimage.distance_transform_edt(~source, return_distances=False, return_indices=True)
    return np.where((weight > 1e-3)[..., None], mean, image[nearest[0], nearest[1]])
