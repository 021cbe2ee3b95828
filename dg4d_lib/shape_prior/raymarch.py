"""Emission-absorption rendering of a volume on the rays of the input camera."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64, UInt8
from scipy import ndimage
from torch import Tensor

from dg4d_lib.cameras.orbit import RADIUS, OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.kernels.compiling import njit
from dg4d_lib.kernels.simd import INLINE, KERNEL
from dg4d_lib.kernels.workers import run_parallel
from dg4d_lib.shape_prior.frustum import BINS, FAR, NEAR, SIZE, TAN_HALF_FOV

CELL = (FAR - NEAR) / BINS  # depth of a cell, world units
BLOCK = 4  # cells of a side that are skipped together
FAINTEST_DENSITY = 0.01  # per cell: thinner matter is left out
STRIDE = 1.25  # depths of a cell from sample to sample
FAINTEST = 0.02  # transmittance at which a ray ends
NARROWEST = 2 * NEAR * TAN_HALF_FOV / SIZE  # width of a cell at the near end, world units: the shortest side of any
BEYOND = 1e-3  # world units: skips end inside of the next block


@dataclass(frozen=True)
class ShapeVolume:
    """Density and color in front of the input camera.

    Attributes:
        cells: row, column, depth; optical density of a cell, then color times density; the part with density alone.
        first: row, column and depth in the frustum of the first of these cells.
        free: Chebyshev distance of every block of `BLOCK` cells a side to the nearest one with density, in blocks.
        box: corners of the world box around them.
    """

    cells: Float32[np.ndarray, "r c d 4"]
    first: Int64[np.ndarray, " 3"]
    free: UInt8[np.ndarray, "t u e"]
    box: Float32[np.ndarray, "2 3"]


def make_volume(density: Float[Tensor, "128 128 64"], color: Float[Tensor, "128 128 64 3"]) -> ShapeVolume:
    """Crop and index the filled part of a volume.

    Args:
        density: optical density of every cell, row, column, depth.
        color: in [0, 1].
    """
    density = torch.where(density < FAINTEST_DENSITY, 0.0, density)
    filled = density > 0
    spans = [_span(filled.any((1, 2))), _span(filled.any((0, 2))), _span(filled.any((0, 1)))]
    part = tuple(slice(*span) for span in spans)
    premultiplied = density[part][..., None] * color[part].clamp(0, 1)
    cells = torch.cat([density[part][..., None], premultiplied], -1).contiguous().numpy()
    first = np.array([span[0] for span in spans])
    return ShapeVolume(cells, first, _free(cells[..., 0] > 0), _box(spans))


def _span(filled: Bool[Tensor, " n"]) -> tuple[int, int]:
    """Return the range of filled places, with an empty one on either side where there is room; at least two."""
    places = filled.nonzero().flatten().tolist() or [0]
    first = max(0, min(places[0] - 1, len(filled) - 2))
    return first, min(len(filled), max(places[-1] + 2, first + 2))


def _free(filled: Bool[np.ndarray, "r c d"]) -> UInt8[np.ndarray, "t u e"]:
    """Return the distance of every block to the nearest filled one, in blocks."""
    counts = [-(-size // BLOCK) for size in filled.shape]
    grown = np.pad(filled, [(0, count * BLOCK - size + 1) for count, size in zip(counts, filled.shape, strict=True)])
    for axis in range(3):  # samples between two cells belong to the block of the first
        grown = grown | np.roll(grown, -1, axis)
    rows, columns, bins = counts
    blocks = grown[:-1, :-1, :-1].reshape(rows, BLOCK, columns, BLOCK, bins, BLOCK).any((1, 3, 5))
    if not blocks.any():
        return np.full(blocks.shape, max(blocks.shape), np.uint8)
    distances: Any = ndimage.distance_transform_cdt(~blocks, "chessboard")  # type: ignore[call-overload]  # SciPy's stub
    return np.ascontiguousarray(distances, np.uint8)


def _box(spans: Sequence[tuple[int, int]]) -> Float32[np.ndarray, "2 3"]:
    """Return the corners of the world box around ranges of rows, columns and depths."""
    rows, columns, bins = (np.array(span) for span in spans)
    distance = NEAR + bins * CELL
    x = np.outer((2 * columns / SIZE - 1) * TAN_HALF_FOV, distance)
    y = np.outer((1 - 2 * rows / SIZE) * TAN_HALF_FOV, distance)
    sides = [(part.min(), part.max()) for part in (x, y, RADIUS - distance)]
    return np.ascontiguousarray(np.array(sides, np.float32).T)


def render_volumes(
    volumes: Sequence[ShapeVolume], cameras: Sequence[OrbitCamera]
) -> tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 1"]]:
    """Render volumes, one per camera.

    Returns:
        Premultiplied color and alpha in [0, 1].

    Raises:
        BadInput: cameras of different sizes, none, or another number of volumes.
    """
    sizes = {(camera.height, camera.width) for camera in cameras}
    if len(sizes) != 1 or len(volumes) != len(cameras):
        raise BadInput(f"{len(volumes)} volumes and {len(cameras)} cameras of sizes {sorted(sizes)}; give one size")
    planes = np.zeros((len(cameras), *sizes.pop(), 4), np.float32)

    def draw(view: int) -> None:
        camera = cameras[view]
        matrix = camera.viewmat().numpy()
        axes = np.ascontiguousarray(matrix[:3, :3].T).astype(np.float32)  # columns: camera axes in the world
        place = (-matrix[:3, :3].T @ matrix[:3, 3]).astype(np.float32)
        volume = volumes[view]
        _march(volume.cells, volume.first, volume.free, volume.box, place, axes, np.float32(camera.focal), planes[view])

    run_parallel([partial(draw, view) for view in range(len(cameras))])
    pictures = torch.from_numpy(planes)
    return pictures[..., :3], pictures[..., 3:]


@njit(**KERNEL)
@no_type_check
def _march(cells, first, free, box, place, axes, focal, picture):
    """Composite samples from front to back; steps are as long as a cell is deep."""
    height, width = picture.shape[:2]
    rows, columns, bins = cells.shape[:3]
    one, half = np.float32(1), np.float32(0.5)
    step, narrowest = np.float32(STRIDE * CELL), np.float32(NARROWEST * BLOCK)
    across, deep = np.float32(SIZE / 2 / TAN_HALF_FOV), np.float32(1 / CELL)
    stride = np.float32(STRIDE)
    beyond = np.float32(BEYOND)
    top, left_side, front = np.float32(first[0] + 0.5), np.float32(first[1] + 0.5), np.float32(first[2] + 0.5)
    middle = np.float32(SIZE / 2)
    for row in range(height):
        y = (row + half - height * half) / focal
        for column in range(width):
            x = (column + half - width * half) / focal
            dx = axes[0, 0] * x + axes[0, 1] * y + axes[0, 2]
            dy = axes[1, 0] * x + axes[1, 1] * y + axes[1, 2]
            dz = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2]
            norm = one / math.sqrt(dx * dx + dy * dy + dz * dz)
            dx, dy, dz = dx * norm, dy * norm, dz * norm
            begin, last = beyond, np.float32(1e9)
            for axis in range(3):
                along = dx if axis == 0 else (dy if axis == 1 else dz)
                near, far = (box[0, axis] - place[axis]) / along, (box[1, axis] - place[axis]) / along
                begin, last = max(begin, min(near, far)), min(last, max(near, far))
            t = (math.floor(begin / step) + half) * step  # the same samples beside each other
            left = one
            red = green = blue = np.float32(0)
            while t < last and left > FAINTEST:
                depth = np.float32(RADIUS) - place[2] - t * dz
                inverse = one / max(depth, half)
                d = (depth - np.float32(NEAR)) * deep - front
                c = middle - left_side + (place[0] + t * dx) * inverse * across
                r = middle - top - (place[1] + t * dy) * inverse * across
                if c < 0 or r < 0 or d < 0 or c >= columns - 1 or r >= rows - 1 or d >= bins - 1:
                    t += step
                    continue
                gap = free[int(r) // BLOCK, int(c) // BLOCK, int(d) // BLOCK]
                if gap:
                    t += max(one, math.floor((gap - 1) * narrowest / step)) * step
                    continue
                total, rs, gs, bs = _sample(cells, r, c, d)
                if total > 0:
                    stay = math.exp(-total * stride)
                    share = left * (one - stay) / total
                    red += share * rs
                    green += share * gs
                    blue += share * bs
                    left *= stay
                t += step
            picture[row, column, 0] = red
            picture[row, column, 1] = green
            picture[row, column, 2] = blue
            picture[row, column, 3] = one - left


@njit(**INLINE)
@no_type_check
def _sample(cells, row, column, depth):
    """Interpolate density and color between the eight cells around a place."""
    i, j, k = int(row), int(column), int(depth)
    one = np.float32(1)
    fr, fc, fd = row - i, column - j, depth - k
    total = red = green = blue = np.float32(0)
    for a in range(2):
        wr = fr if a else one - fr
        for b in range(2):
            wc = wr * (fc if b else one - fc)
            lower, upper = cells[i + a, j + b, k], cells[i + a, j + b, k + 1]
            u, v = wc * (one - fd), wc * fd
            total += u * lower[0] + v * upper[0]
            red += u * lower[1] + v * upper[1]
            green += u * lower[2] + v * upper[2]
            blue += u * lower[3] + v * upper[3]
    return total, red, green, blue
