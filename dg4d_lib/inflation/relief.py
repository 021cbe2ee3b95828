"""Relief of the side that a picture shows, from relative inverse depth."""

import numpy as np
from jaxtyping import Bool, Float64
from scipy import ndimage

SMOOTH = 1.5  # pixels
FARTHEST = 0.3  # world units: largest shift of the surface
FEWEST = 16  # pixels of a subject


def relief(
    disparity: Float64[np.ndarray, "s s"],
    front: Float64[np.ndarray, "s s"],
    mask: Bool[np.ndarray, "s s"],
    weight: float,
) -> Float64[np.ndarray, "s s"]:
    """Return the shift towards the camera that brings a surface closer to an estimated depth, world units.

    Scale and offset of the estimate are unknown: they are fitted to the surface by least squares. An estimate that
    falls where the surface rises says nothing and shifts nothing.

    Args:
        disparity: larger where nearer, up to scale and offset.
        front: depth of the surface towards the camera, world units.
        mask: of the subject.
        weight: share of the difference that is taken on.
    """
    none = np.zeros(mask.shape)
    if mask.sum() < FEWEST or not np.isfinite(disparity[mask]).all():
        return none
    seen, depth = disparity[mask] - disparity[mask].mean(), front[mask] - front[mask].mean()
    variance = float(seen @ seen)
    slope = float(seen @ depth) / variance if variance > 0 else 0.0
    if slope <= 0:
        return none
    difference = np.where(mask, slope * (disparity - disparity[mask].mean()) - (front - front[mask].mean()), 0.0)
    share = ndimage.gaussian_filter(mask.astype(float), SMOOTH)
    smooth = ndimage.gaussian_filter(difference, SMOOTH) / np.maximum(share, 1e-6)
    shift: Float64[np.ndarray, "s s"] = np.where(mask, weight * smooth, 0.0).clip(-FARTHEST, FARTHEST)
    return shift
