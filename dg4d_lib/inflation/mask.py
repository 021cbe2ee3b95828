"""Mask of the subject's pixels."""

import numpy as np
from jaxtyping import Bool, Float64
from scipy import ndimage

from dg4d_lib.errors import BadInput

FAINTEST = 0.05  # alpha below which a picture counts as empty
SMALLEST_PIXELS = 16  # fewer opaque pixels, or a smaller share of the picture, means that the subject is translucent
SMALLEST_SHARE = 5e-4
SPECK_PIXELS = 4  # parts below this, or below this share of the subject, are dropped
SPECK_SHARE = 4e-4
PINHOLE_PIXELS = 2  # holes up to this, or up to this share of the picture, are filled
PINHOLE_SHARE = 2e-5


def subject_mask(alpha: Float64[np.ndarray, "h w"]) -> tuple[Bool[np.ndarray, "h w"], Float64[np.ndarray, "h w"]]:
    """Return the subject's pixels without specks and pin holes, and an alpha whose level 0.5 is their outline.

    Args:
        alpha: in [0, 1]; a subject that is translucent everywhere is taken at half of its greatest alpha.

    Raises:
        BadInput: there is no subject.
    """
    greatest = float(alpha.max())
    mask = alpha > 0.5
    if mask.sum() < max(SMALLEST_PIXELS, SMALLEST_SHARE * mask.size) and greatest > FAINTEST:
        alpha = alpha / greatest
        mask = alpha > 0.5
    if not mask.any():
        raise BadInput(
            f"the picture shows no subject: its alpha is at most {greatest:.2f}, at least {FAINTEST} is needed; "
            "give a cut-out picture, or an opaque one with the subject on a plain background"
        )
    mask = _without_specks(mask)
    return _without_pinholes(mask), alpha


def _without_specks(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    parts, _ = ndimage.label(mask, np.ones((3, 3)))
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    keep = sizes >= min(max(SPECK_PIXELS, SPECK_SHARE * sizes.sum()), sizes.max())
    return keep[parts] & mask


def _without_pinholes(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    holes, _ = ndimage.label(~mask)
    sizes = np.bincount(holes.ravel())
    return mask | (sizes <= max(PINHOLE_PIXELS, PINHOLE_SHARE * mask.size))[holes]
