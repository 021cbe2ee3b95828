"""Triangulation of polygons: as fans where these fit, else by ear clipping (Meisters 1975)."""

from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int

from dg4d_lib.kernels.compiling import njit

MOST_CORNERS = 1024  # of a polygon whose ears are cut; larger ones become fans, since the time grows with the square
EMPTY = 1e-6  # area of a triangle, as a share of the polygon's, up to which its orientation does not count
CHUNK = 2**18  # corners of polygons that are looked at together, which bounds the memory


def triangulate(
    points: Float[np.ndarray, "v 3"], indices: Int[np.ndarray, " c"], counts: Int[np.ndarray, " p"]
) -> Int[np.ndarray, "t 3"]:
    """Return the corners of the triangles that polygons are split into, two fewer than the polygon has corners.

    Args:
        points: in any units.
        indices: points at the corners of all polygons, one polygon after the other.
        counts: number of corners of every polygon; polygons of less than three have no triangles.

    Returns:
        Positions in `indices`, in the order of the polygons and with their orientation.
    """
    corners = np.cumsum(counts) - counts
    triangles = (counts - 2).clip(0)
    first = np.cumsum(triangles) - triangles
    starts = np.repeat(corners, triangles)
    number = np.arange(len(starts)) - np.repeat(first, triangles)
    found = np.stack([starts, starts + number + 1, starts + number + 2], 1)
    for count in np.unique(counts[(counts > 3) & (counts <= MOST_CORNERS)]):
        same = np.flatnonzero(counts == count)
        step = max(1, CHUNK // int(count))
        for some in (same[start : start + step] for start in range(0, len(same), step)):
            flat, folded = _flattened(points[indices[corners[some, None] + np.arange(count)]])
            selected = some[folded]
            if len(selected):
                rows = first[selected, None] + np.arange(count - 2)
                found[rows] = corners[selected, None, None] + _cut_ears(flat[folded])
    return found


def _flattened(
    corners: Float[np.ndarray, "p n 3"],
) -> tuple[Float[np.ndarray, "p n 2"], Bool[np.ndarray, " p"]]:
    """Return polygons in the plane of their Newell normal, counter-clockwise, and whose fans have inverted triangles.

    The first corner is the origin of the plane.
    """
    with np.errstate(all="ignore"):  # polygons without area, and numbers that are not finite, become fans
        relative = corners - corners[:, :1]
        normals = 0.5 * np.cross(relative, np.roll(relative, -1, 1)).sum(1)
        areas = np.linalg.norm(normals, axis=1)
        axis = normals / areas[:, None]
        side = np.eye(3)[np.abs(axis).argmin(1)]
        right = np.cross(side, axis)
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        up = np.cross(axis, right)
        flat = np.stack([np.einsum("pnc,pc->pn", relative, way) for way in (right, up)], -1)
        x, y = flat[..., 0], flat[..., 1]
        fan = 0.5 * (x[:, :-1] * y[:, 1:] - y[:, :-1] * x[:, 1:])
        return flat, (fan < -EMPTY * areas[:, None]).any(1)


@njit(cache=True, nogil=True)
@no_type_check
def _cut_ears(polygons):
    """Return the corners of the triangles of polygons, which are counter-clockwise and have equally many corners."""
    count = polygons.shape[1]
    found = np.empty((len(polygons), count - 2, 3), np.int64)
    before, after = np.empty(count, np.int64), np.empty(count, np.int64)
    areas, ears = np.empty(count), np.empty(count, np.bool_)
    for number in range(len(polygons)):
        corners = polygons[number]
        for k in range(count):
            before[k], after[k] = (k - 1) % count, (k + 1) % count
        for k in range(count):
            areas[k], ears[k] = _test_ear(corners, before, after, k)
        start = 0
        for triangle in range(count - 2):
            tip = k = start
            for _ in range(count - triangle):
                if ears[k]:
                    tip = k
                    break
                if areas[k] > areas[tip]:  # polygons that cross themselves may have no ear
                    tip = k
                k = after[k]
            first, last = before[tip], after[tip]
            found[number, triangle] = first, tip, last
            after[first], before[last] = last, first
            for k in (first, last):
                areas[k], ears[k] = _test_ear(corners, before, after, k)
            start = last
    return found


@njit(cache=True, nogil=True)
@no_type_check
def _test_ear(corners, before, after, tip):
    """Return the area of the triangle at a corner, and whether it is an ear: no other corner is in it.

    Corners at the same place as one of the three do not count: holes are cut in with them.
    """
    a, b, c = corners[before[tip]], corners[tip], corners[after[tip]]
    area = _area(a, b, c)
    if area <= 0:
        return area, False
    k = after[after[tip]]
    while k != before[tip]:
        other = corners[k]
        if _area(a, b, other) > 0 and _area(b, c, other) > 0 and _area(c, a, other) >= 0:
            return area, False
        k = after[k]
    return area, True


@njit(cache=True, nogil=True)
@no_type_check
def _area(a, b, c):
    """Return the area of a triangle, positive if counter-clockwise."""
    return 0.5 * ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
