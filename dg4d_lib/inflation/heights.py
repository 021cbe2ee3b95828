"""Heights of an inflated silhouette: half the union of its inscribed balls, half the solution of a Poisson equation.

The balls are medial-axis inflation without a skeleton: limbs come out round, heads nearly spherical. The Poisson
membrane has no creases and is the steadier over time. Both scale with the picture. (After Baran and Lehtinen, Notes on
Inflating Curves, 2009; Teddy, 1999; Monster Mash, 2020.)
"""

import numpy as np
from jaxtyping import Bool, Float64
from scipy import ndimage

from dg4d_lib.inflation.grid import solve_on_grid

SWELL = 1.2  # times the height of the blend: 1.1 to 1.3 score the same PSNR, thicker covers more of unseen outlines
GREATEST = 0.75  # world units: no height is above
SLAB = 0.35  # half thickness of a picture without any outline, as a share of its height
PEAK = 4.0  # the membrane's square is at most this times the balls'
ANCHOR = 1e-9  # keeps the membrane of a part without an outline finite


def heights(mask: Bool[np.ndarray, "h w"], pixel: float) -> Float64[np.ndarray, "h w"]:
    """Return half the thickness at every pixel, 0 outside.

    The border of the picture is not an outline: parts that it cuts keep their thickness there.

    Args:
        mask: the subject.
        pixel: size of a pixel, world units.

    Returns:
        World units, at most `GREATEST`.
    """
    if mask.all():
        squares = np.full(mask.shape, (SLAB * mask.shape[0]) ** 2)
    else:
        balls = inscribed_balls(mask)
        squares = 0.5 * balls + 0.5 * np.minimum(membrane(mask), PEAK * balls.max())
    return np.minimum(SWELL * np.sqrt(squares) * pixel, GREATEST) * mask


def outline_distance(mask: Bool[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w"]:
    """Return the distance to the nearest pixel outside, in pixels, as if the picture went on beyond its border."""
    margin = max(mask.shape) // 2
    distance = ndimage.distance_transform_edt(np.pad(mask, margin, mode="edge"))
    return np.ascontiguousarray(distance[margin : margin + mask.shape[0], margin : margin + mask.shape[1]])


def inscribed_balls(mask: Bool[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w"]:
    """Return the squared height of the union of all balls inside, pixels squared: max over c of d(c)^2 - |x - c|^2.

    A dilation by a paraboloid, one axis after the other.
    """
    distance = outline_distance(mask)
    squares = np.where(mask, distance**2, -np.inf)
    for _ in range(2):
        squares = squares.T
        source = squares.copy()
        for step in range(1, min(int(distance.max()) + 2, len(squares))):
            np.maximum(squares[step:], source[:-step] - step**2, out=squares[step:])
            np.maximum(squares[:-step], source[step:] - step**2, out=squares[:-step])
    return np.where(mask, np.maximum(squares, 0), 0)


def membrane(mask: Bool[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w"]:
    """Return the squared height u, pixels squared: minus Laplacian of u = 2 in the mask, u = 0 outside.

    A long strip becomes a round rod, a disc an ellipsoid 0.71 as high as a ball.
    """
    sides = np.full(mask.shape, 4.0)
    sides[[0, -1]] -= 1  # no flow through the picture's border
    sides[:, [0, -1]] -= 1
    result = np.zeros(mask.shape)
    result[mask] = solve_on_grid(mask, sides[mask] + ANCHOR, np.full(int(mask.sum()), 2.0))
    return np.maximum(result, 0)


def local_radius(mask: Bool[np.ndarray, "h w"], distance: Float64[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w"]:
    """Return the radius of the largest inscribed disc that covers a pixel, in pixels; 0 outside."""
    radius = np.where(mask, distance, 0.0)
    centers = mask & (distance >= ndimage.maximum_filter(distance, 3) - 1e-9)
    for row, column in np.argwhere(centers).tolist():
        reach = float(distance[row, column])
        top, left = max(0, row - int(reach) - 1), max(0, column - int(reach) - 1)
        window = radius[top : row + int(reach) + 2, left : column + int(reach) + 2]
        dy = np.arange(window.shape[0]) + top - row
        dx = np.arange(window.shape[1]) + left - column
        np.maximum(window, reach, out=window, where=dy[:, None] ** 2 + dx**2 <= reach**2)
    return radius * mask
