"""Turn of a walking or standing subject from the ground line of its footage."""

import math

import numpy as np
from jaxtyping import Float, Float64
from torch import Tensor

from dg4d_lib.cameras.orbit import FOV_Y_DEG

SUBJECT = 0.5  # alpha from which a pixel belongs to the subject
FEWEST_FRAMES = 8  # single frames show raised feet: on synthetic poses their line is uninformative
NARROWEST = 0.3  # least length, share of the subject's width; shorter: wrong sign for half of the synthetic shapes
SMALLEST_GAP = 0.1  # mean free height below the line, of its length: a solid base has two sides, and either may be long
NEAREST_HORIZON = 0.02  # of the picture's height: depth is unbounded there
LARGEST_DEG = 25.0


def ground_turn(alpha: Float[Tensor, "t h w 1"], trust: float) -> float | None:
    """Return the turn of the subject's plane about the vertical, degrees; see `inflate`.

    The feet of all frames stand on one plane. Seen from elevation 0, the depth of a point on it is inversely
    proportional to its distance below the horizon, the middle of the picture. The line is the edge of the lower convex
    hull of all silhouettes that lies under their centroid.

    Args:
        alpha: alpha of the footage, in [0, 1].
        trust: factor on the angle, in [0, 1]; the result is clipped to 25 degrees.

    Returns:
        0 for a level line; None where there is no trust or the line says nothing: few frames, a short line, a solid
        base, or feet at the horizon.
    """
    shown = (alpha[..., 0] > SUBJECT).any(0).cpu().numpy()
    if not trust or len(alpha) < FEWEST_FRAMES or not shown.any():
        return None
    height, width = shown.shape
    columns = np.flatnonzero(shown.any(0))
    lowest = height - shown[::-1].argmax(0)[columns]
    corners = _lower_hull(np.stack([columns + 0.5, lowest.astype(np.float64)], -1))
    if len(corners) < 2:
        return None
    centroid = np.nonzero(shown)[1].mean() + 0.5
    right = int(np.searchsorted(corners[:, 0], centroid).clip(1, len(corners) - 1))
    (x0, y0), (x1, y1) = ends = corners[right - 1 : right + 1]
    below = (columns > x0) & (columns < x1)
    line = y0 + (y1 - y0) * (columns[below] + 0.5 - x0) / (x1 - x0)
    gap = (line - lowest[below]).mean() / (x1 - x0) if below.any() else 0.0
    narrow = x1 - x0 < NARROWEST * len(columns)
    if narrow or gap < SMALLEST_GAP or min(y0, y1) < (0.5 + NEAREST_HORIZON) * height:
        return None
    angles = (2 * ends - (width, height)) / height * math.tan(math.radians(FOV_Y_DEG) / 2)
    depth = 1 / angles[:, 1]  # in units of the camera's height above the ground
    across = angles[:, 0] * depth
    turn = math.degrees(math.atan2(depth[0] - depth[1], across[1] - across[0]))
    return float(np.clip(trust * turn, -LARGEST_DEG, LARGEST_DEG))


def _lower_hull(points: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "k 2"]:
    """Return the corners of the convex hull on the side of greater y, by x (Andrew's monotone chain)."""
    hull: list[Float64[np.ndarray, " 2"]] = []
    for point in points:
        while len(hull) > 1:
            (ax, ay), (bx, by) = hull[-1] - hull[-2], point - hull[-2]
            if ax * by - ay * bx < 0:
                break
            hull.pop()
        hull.append(point)
    return np.array(hull)
