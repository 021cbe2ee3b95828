"""Colors of the inflated surface: the picture in front, its rim diffused inwards behind."""

import numpy as np
from jaxtyping import Bool, Float64
from scipy import ndimage

from dg4d_lib.inflation.grid import neighbor_counts, solve_on_grid
from dg4d_lib.inflation.heights import local_radius, outline_distance

OPAQUE = 0.95  # alpha from which a pixel's color is the subject's own
NEARLY_OPAQUE = 0.8
THIN = 3.0  # pixels: parts farther than this from any sure pixel are too thin for the erosion
THINNER = 6.0  # pixels: parts farther than this may also be translucent
RIM_LENGTH = 0.008  # diffusion length of colors at the rim, share of the picture's height
CORE_LENGTH = 0.04  # the same in the core of wide parts: large patches of the front stay, a face does not
RIM_SHARE = 0.4  # distance from the outline where the core begins, share of the local radius


def front_colors(
    colors: Float64[np.ndarray, "h w 3"], alpha: Float64[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"]
) -> Float64[np.ndarray, "h w 3"]:
    """Return the picture's colors; pixels at the outline, mixed with the background, take the nearest sure color."""
    opaque = mask & (alpha > OPAQUE)
    sure = opaque & ndimage.binary_erosion(opaque)
    gap = ndimage.distance_transform_edt(~sure) if sure.any() else np.full(mask.shape, np.inf)
    sure = sure | (opaque & (gap > THIN)) | (mask & (alpha > NEARLY_OPAQUE) & (gap > THINNER))
    rows, columns = ndimage.distance_transform_edt(
        ~(sure if sure.any() else mask), return_distances=False, return_indices=True
    )
    return colors[rows, columns]


def back_colors(front: Float64[np.ndarray, "h w 3"], mask: Bool[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w 3"]:
    """Return the colors of the unseen side.

    They equal the front's at the rim (no seam); in the core of wide parts they are filled in from the rim, with a faint
    blurred mirror image of the front: the least of sum |c_i - c_j|^2 + sum w_i |c_i - front_i|^2.
    """
    if mask.all():
        return front
    height = mask.shape[0]
    distance = outline_distance(mask)
    radius = np.maximum(_blur_inside(local_radius(mask, distance), mask, RIM_LENGTH * height), 1)
    depth = np.clip(distance / (RIM_SHARE * radius), 0, 1)
    weight = ((1 - depth) ** 2 / (RIM_LENGTH * height) ** 2 + 1 / (CORE_LENGTH * height) ** 2)[mask]
    result = front.copy()
    result[mask] = solve_on_grid(mask, neighbor_counts(mask) + weight, weight[:, None] * front[mask])
    return np.clip(result, 0, 1)


def _blur_inside(
    values: Float64[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"], sigma: float
) -> Float64[np.ndarray, "h w"]:
    """Blur values with a Gaussian, normalized inside the mask."""
    share = ndimage.gaussian_filter(mask.astype(np.float64), sigma)
    return ndimage.gaussian_filter(values * mask, sigma) / np.maximum(share, 1e-6) * mask
