"""Packing of flat charts into a square texture: the largest common scale at which all find a place.

Charts are placed one after the other, large ones first, each at the first free place of a grid from below, in the turn
in which its center then lies lowest. Several orders are tried. Charts are turned, never mirrored.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray

from dg4d_lib.kernels.compiling import njit

FINEST = 512  # cells per side of the grid of places, at most
GAP = 2  # texels between charts, at least
MOST_SHAPES = 640  # charts times turns; more charts are turned less
DISTURBANCE = 0.25  # standard deviation of the logarithm of the area in a disturbed order
FIRST_COVERAGE = 0.66  # share of the texture that is tried first
LEAST_COVERAGE = 0.03  # share of the texture below which charts count as too many
GOLDEN = 0.618  # multiples of this share of a length are spread evenly

Array = NDArray[np.float64]
Placed = list[tuple[NDArray[np.int64], Array]]  # vertices of every chart and their places, cells


class Effort(NamedTuple):
    """Numbers of rotations and orders that a packing tries.

    Attributes:
        turns: rotations of a chart, numbers that the orders take in turn; the largest is a multiple of the others. More
            are not always better, for a chart takes the lowest place without regard to those that follow.
        orders: of the charts: the first by area, the others disturbed.
        step: increments of the share of the texture that the charts cover.
    """

    turns: tuple[int, ...]
    orders: int
    step: float


QUICK, THOROUGH = Effort((8,), 8, 0.01), Effort((8, 16), 48, 0.005)  # less than a second, and one to three


def pack_charts(
    flat: Float[np.ndarray, "w 2"],
    faces: Int[np.ndarray, "f 3"],
    labels: Int[np.ndarray, " f"],
    size: int,
    effort: Effort = QUICK,
) -> Float[np.ndarray, "w 2"] | None:
    """Place charts side by side, all at one scale and at least two texels apart.

    Args:
        flat: position of every vertex in the plane of its chart, counter-clockwise with v up.
        faces: triangles of all charts.
        labels: chart of every face, numbered from 0.
        size: side of the texture, texels.
        effort: ways of packing that are tried.

    Returns:
        Texture coordinates in [0, 1], v down; None if there is no room for so many charts.
    """
    grid = min(FINEST, size)
    gap = -(-GAP * grid // size)  # cells
    order = np.argsort(labels, kind="stable")
    members = np.split(faces[order], np.flatnonzero(np.diff(labels[order])) + 1)
    most = int(np.clip(MOST_SHAPES // len(members), 1, max(effort.turns)))
    best = _place_all([_Chart(flat, part, most, gap) for part in members], grid, gap, effort)
    if best is None:
        return None
    uvs = np.zeros(flat.shape)
    for vertices, places in best:
        uvs[vertices] = places / grid
    uvs[:, 1] = 1 - uvs[:, 1]
    return uvs


class _Chart:
    """A chart's area, and its vertices in every turn with the lower left corner at the origin."""

    def __init__(self, flat: Array, faces: Int[np.ndarray, "f 3"], turns: int, gap: int) -> None:
        self.gap = gap
        self.vertices, local = np.unique(faces, return_inverse=True)
        self.faces = local.reshape(-1, 3)
        points = flat[self.vertices]
        sides = points[self.faces[:, 1:]] - points[self.faces[:, :1]]
        self.area = float((sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]).sum() / 2)
        upright = _tightest_turn(points)
        self.turned = [_turn(points, upright + angle) for angle in 2 * np.pi * np.arange(turns) / turns]
        self.scale, self.known = 0.0, dict[int, _Shape]()  # of the last scale: a packing returns to no earlier one

    def shapes(self, scale: float, stride: int) -> Iterator["_Shape"]:
        """Yield the cells that the chart occupies in every `stride`-th turn at a scale, cells per unit."""
        if scale != self.scale:
            self.scale, self.known = scale, {}
        for turn in range(0, len(self.turned), stride):
            if turn not in self.known:
                self.known[turn] = _Shape(self.turned[turn] * scale, self.faces, self.gap)
            yield self.known[turn]


class _Shape:
    """Cells of a chart in one turn: those that it touches, and with the gap around it, in scattered order."""

    def __init__(self, points: Array, faces: Int[np.ndarray, "f 3"], gap: int) -> None:
        self.points = points
        self.height, self.width = (int(side) + 1 for side in points.max(0)[::-1])
        self.marked = np.zeros((self.height, self.width), np.bool_)
        _mark_cells(points, faces, self.marked)
        self.center, self.cells = _center_and_cells(self.marked, gap)


def _tightest_turn(points: Array) -> float:
    """Return the rotation, out of steps of 3 degrees, whose bounding box is smallest."""
    angles = np.pi / 2 * np.arange(30) / 30
    boxes = [np.prod(np.ptp(_turn(points, angle), axis=0)) for angle in angles]
    return float(angles[int(np.argmin(boxes))])


def _turn(points: Array, angle: float) -> Array:
    cosine, sine = np.cos(angle), np.sin(angle)
    turned = points @ np.array([[cosine, sine], [-sine, cosine]])
    return np.asarray(turned - turned.min(0))


def _place_all(charts: list[_Chart], grid: int, gap: int, effort: Effort) -> Placed | None:
    """Place all charts at the largest scale that is found, or return None if there is none."""
    total, areas = sum(chart.area for chart in charts), np.array([chart.area for chart in charts])
    generator = np.random.default_rng(0)
    best, covered = None, FIRST_COVERAGE
    for turn in range(effort.orders if len(charts) <= MOST_SHAPES else 1):
        stride = max(effort.turns) // effort.turns[turn % len(effort.turns)]
        noise = generator.normal(size=len(charts)) * (DISTURBANCE if best is not None else 0)
        order = [charts[index] for index in np.argsort(noise - np.log(areas), kind="stable")]
        while best is None and covered > LEAST_COVERAGE:
            best = _place(order, grid, gap, grid * np.sqrt(covered / total), stride)
            covered = covered if best is not None else 0.95 * covered
        if best is None:
            return None
        while (better := _place(order, grid, gap, grid * np.sqrt((covered + effort.step) / total), stride)) is not None:
            best, covered = better, covered + effort.step
    return best


def _place(charts: list[_Chart], grid: int, gap: int, scale: float, stride: int) -> Placed | None:
    """Place charts one after the other at a scale, in every `stride`-th of their turns; None if one finds no place."""
    taken = np.zeros((grid + 2 * gap, grid + 2 * gap), np.bool_)  # charts may touch the border of the texture
    next_free = np.tile(np.arange(grid + 2 * gap), (grid + 2 * gap, 1))
    placed: Placed = []
    for chart in charts:
        lowest: tuple[float, int, int, _Shape] | None = None
        for shape in chart.shapes(scale, stride):
            last = grid - shape.height
            if lowest is not None:
                last = min(last, int(lowest[0] - shape.center))
            row, column = _first_place(taken, next_free, shape.cells, last, grid - shape.width)
            if row >= 0 and (lowest is None or row + shape.center < lowest[0]):
                lowest = row + shape.center, row, column, shape
        if lowest is None:
            return None
        _, row, column, shape = lowest
        rows = slice(row + gap, row + gap + shape.height)
        taken[rows, column + gap : column + gap + shape.width] |= shape.marked
        _find_next_free(taken[rows], next_free[rows])
        placed.append((chart.vertices, shape.points + np.array([column, row])))
    return placed


@njit(cache=True, nogil=True)
@no_type_check
def _mark_cells(points, faces, marked):
    """Mark every cell that a triangle touches: no edge and no side of the cell separates the two."""
    height, width = marked.shape
    for f in range(len(faces)):
        xa, ya = points[faces[f, 0], 0], points[faces[f, 0], 1]
        xb, yb = points[faces[f, 1], 0], points[faces[f, 1], 1]
        xc, yc = points[faces[f, 2], 0], points[faces[f, 2], 1]
        for row in range(max(0, int(min(ya, yb, yc))), min(height - 1, int(max(ya, yb, yc))) + 1):
            for column in range(max(0, int(min(xa, xb, xc))), min(width - 1, int(max(xa, xb, xc))) + 1):
                if marked[row, column]:
                    continue
                outside = False
                for side in range(3):
                    if side == 0:
                        px, py, dx, dy = xa, ya, xb - xa, yb - ya
                    elif side == 1:
                        px, py, dx, dy = xb, yb, xc - xb, yc - yb
                    else:
                        px, py, dx, dy = xc, yc, xa - xc, ya - yc
                    x = column + (1 if dy < 0 else 0)  # corner of the cell that lies farthest to the left of the edge
                    y = row + (1 if dx > 0 else 0)
                    if dx * (y - py) - dy * (x - px) < 0:
                        outside = True
                        break
                if not outside:
                    marked[row, column] = True


@njit(cache=True, nogil=True)
@no_type_check
def _center_and_cells(marked, gap):
    """Return the mean row of the marked cells, and in scattered order the cells at most a gap away from one."""
    height, width = marked.shape
    beside = np.zeros((height, width + 2 * gap), np.bool_)  # marked cells grown along rows, then along columns
    around = np.zeros((height + 2 * gap, width + 2 * gap), np.bool_)
    rows, count, size = 0, 0, 0
    for row in range(height):
        reached = -1  # first column that no marked cell of the row has grown to
        for column in range(width):
            if marked[row, column]:
                rows, count = rows + row, count + 1
                for place in range(max(column, reached), column + 2 * gap + 1):
                    beside[row, place] = True
                reached = column + 2 * gap + 1
    for row in range(height + 2 * gap):
        for column in range(width + 2 * gap):
            for other in range(max(0, row - 2 * gap), min(height, row + 1)):
                if beside[other, column]:
                    around[row, column] = True
                    size += 1
                    break
    cells, found = np.empty((size, 2), np.int32), 0
    stride = max(1, int(GOLDEN * size))  # scattered: a collision shows after few cells
    while math.gcd(stride, size) > 1:
        stride += 1
    for row in range(height + 2 * gap):
        for column in range(width + 2 * gap):
            if around[row, column]:
                cells[found, 0], cells[found, 1] = row, column
                found = (found + stride) % size
    return rows / count, cells


@njit(cache=True, nogil=True)
@no_type_check
def _find_next_free(taken, next_free):
    """Write the column of the next free cell to the right of every cell, or the cell's own column."""
    for row in range(taken.shape[0]):
        beyond = taken.shape[1]
        for column in range(taken.shape[1] - 1, -1, -1):
            if not taken[row, column]:
                beyond = column
            next_free[row, column] = beyond


@njit(cache=True, nogil=True)
@no_type_check
def _first_place(taken, next_free, cells, last_row, last_column):
    """Return the lowest, then leftmost place at which no cell is taken, or -1."""
    for row in range(last_row + 1):
        column = 0
        while column <= last_column:
            blocked = 0
            for i in range(len(cells)):
                if taken[row + cells[i, 0], column + cells[i, 1]]:
                    blocked = next_free[row + cells[i, 0], column + cells[i, 1]] - cells[i, 1] - column
                    break
            if blocked == 0:
                return row, column
            column += blocked
    return -1, -1
