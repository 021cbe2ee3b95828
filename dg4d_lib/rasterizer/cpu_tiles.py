"""Alpha blending of the tile lists, and its backward pass.

Vectors of pixels covered by a batch of Gaussians are listed first and then blended in one flat loop (`cpu_blend`);
nested loops over rows would lose time to mispredicted branches.
"""

from typing import no_type_check

import numpy as np

from dg4d_lib.kernels.compiling import njit
from dg4d_lib.kernels.simd import INLINE, KERNEL, LANES
from dg4d_lib.rasterizer.cpu_bins import TILE
from dg4d_lib.rasterizer.cpu_blend import (
    BACKWARD_PLANES,
    FORWARD_PLANES,
    MAX_VECTORS,
    OVERRUN,
    PLANE,
    PLANE_SHAPE,
    blend_list,
    blend_list_backward,
    cover,
    prefetch,
)
from dg4d_lib.rasterizer.cpu_project import RECORD

NOT_STOPPED = np.float32(3e9)  # list position at which a pixel stopped, for one that did not

_BATCH = 32  # Gaussians whose vectors are listed before blending
_BATCH_VECTORS = 512  # vectors that end a batch early
_LIST_SIZE = _BATCH_VECTORS + MAX_VECTORS + OVERRUN
_ZERO, _ONE = np.float32(0), np.float32(1)


@njit(**KERNEL)
@no_type_check
def blend(
    records, offsets, entries, background, color, alpha, depth, transmittance, stops, stopped, first, last
):  # fmt: skip
    """Render tiles first..last.

    For the backward pass also store the final transmittance, whether any pixel of a tile stopped early, and if so the
    list position at which each pixel stopped.
    """
    height, width = alpha.shape
    tiles_x = (width + TILE - 1) // TILE
    state = np.empty((FORWARD_PLANES, *PLANE_SHAPE), np.float32)
    positions, us, vs = (
        np.empty(_LIST_SIZE, np.int32),
        np.empty(_LIST_SIZE, np.float32),
        np.empty(_LIST_SIZE, np.float32),
    )
    masks, ends = np.empty(_LIST_SIZE, np.int32), np.empty(_BATCH, np.int64)
    for tile in range(first, last):
        left, top = tile % tiles_x * TILE, tile // tiles_x * TILE
        columns, rows = min(TILE, width - left), min(TILE, height - top)
        begin, end = offsets[tile], offsets[tile + 1]
        stopped[tile] = False
        alive = columns * rows
        _reset(state, columns, rows)
        while begin < end and alive > 0:
            length, count = 0, 0
            while count < _BATCH and length < _BATCH_VECTORS and begin + count < end:
                prefetch(records, np.int64(entries[min(begin + count + 8, end - 1)]) * RECORD)
                g = np.int64(entries[begin + count])
                length = cover(records, g, np.float32(left), np.float32(top), positions, us, vs, length)
                ends[count] = length
                count += 1
            start = 0
            for i in range(count):
                g = np.int64(entries[begin + i])
                if blend_list(state, positions, us, vs, masks, start, ends[i], records, g) != 0:
                    if not stopped[tile]:
                        stopped[tile] = True
                        stops[tile, :] = NOT_STOPPED
                    alive -= _record_stops(masks, positions, start, ends[i], begin + i - offsets[tile], stops[tile])
                start = ends[i]
            begin += count
        _write(state, background, color, alpha, depth, transmittance, left, top, columns, rows)


@njit(**KERNEL)
@no_type_check
def blend_backward(
    records, offsets, entries, background, grad_color, grad_alpha, grad_depth, transmittance, stops, stopped,
    slots, grad_records, first, last,
):  # fmt: skip
    """Write the gradient of the record of every entry i of tiles first..last to grad_records[slots[i]]."""
    height, width = grad_alpha.shape
    tiles_x = (width + TILE - 1) // TILE
    state = np.zeros((BACKWARD_PLANES, *PLANE_SHAPE), np.float32)
    positions, us, vs = (
        np.empty(_LIST_SIZE, np.int32),
        np.empty(_LIST_SIZE, np.float32),
        np.empty(_LIST_SIZE, np.float32),
    )
    ends = np.empty(_BATCH, np.int64)
    never = np.full(PLANE, NOT_STOPPED, np.float32)
    for tile in range(first, last):
        begin, end = offsets[tile], offsets[tile + 1]
        if begin == end:
            continue
        left, top = tile % tiles_x * TILE, tile // tiles_x * TILE
        columns, rows = min(TILE, width - left), min(TILE, height - top)
        limits = stops[tile] if stopped[tile] else never
        _read(state, background, grad_color, grad_alpha, grad_depth, transmittance, left, top, columns, rows)
        while end > begin:
            length, count = 0, 0
            while count < _BATCH and length < _BATCH_VECTORS and end - count > begin:
                ahead = max(end - count - 9, begin)
                prefetch(records, np.int64(entries[ahead]) * RECORD)
                prefetch(grad_records, np.int64(slots[ahead]) * RECORD)
                g = np.int64(entries[end - count - 1])
                length = cover(records, g, np.float32(left), np.float32(top), positions, us, vs, length)
                ends[count] = length
                count += 1
            start = 0
            for i in range(count):
                entry = end - i - 1
                g, slot, place = np.int64(entries[entry]), np.int64(slots[entry]), np.float32(entry - begin)
                blend_list_backward(
                    state, positions, us, vs, start, ends[i], records, g, limits, place, grad_records, slot
                )
                start = ends[i]
            end -= count


@njit(**KERNEL)
@no_type_check
def assign_rows(entries, count, slots):
    """Assign every entry a row of its own in grad_records; return the number of rows (<= count + len(entries)).

    The first entry of Gaussian g gets row g, further ones get rows from `count` on.
    """
    seen = np.zeros(count, np.bool_)
    rows = count
    for i in range(len(entries)):
        g = entries[i]
        slots[i] = rows if seen[g] else g
        rows += seen[g]
        seen[g] = True
    return rows


@njit(**KERNEL)
@no_type_check
def add_duplicates(entries, slots, count, grad_records):
    """Add the rows of further entries to those of their Gaussians, in list order."""
    for i in range(len(entries)):
        if slots[i] >= count:
            for field in range(RECORD):
                grad_records[entries[i], field] += grad_records[slots[i], field]


@njit(**INLINE)
@no_type_check
def _reset(state, columns, rows):
    """Set full transmittance inside the image and mark pixels outside as stopped."""
    state[0] = -_ONE
    state[1:] = _ZERO
    for pair in range(rows >> 1):
        for x in range(columns):
            state[0, pair, x, 0] = state[0, pair, x, 1] = _ONE
    if rows & 1:
        state[0, rows >> 1, :columns, 0] = _ONE


@njit(**KERNEL)
@no_type_check
def _record_stops(masks, positions, start, end, place, stops):
    count = 0
    for j in range(start, end):
        for lane in range(LANES):
            if masks[j] >> lane & 1:
                stops[positions[j] + lane] = place
                count += 1
    return count


@njit(**INLINE)
@no_type_check
def _write(state, background, color, alpha, depth, transmittance, left, top, columns, rows):
    """Copy a tile into the image."""
    spare = np.empty(TILE, np.float32)
    for pair in range((rows + 1) >> 1):
        upper, lower = _pair_of_rows(transmittance, top + 2 * pair, left, columns, spare)
        for x in range(columns):
            upper[x], lower[x] = abs(state[0, pair, x, 0]), abs(state[0, pair, x, 1])
        upper, lower = _pair_of_rows(alpha, top + 2 * pair, left, columns, spare)
        for x in range(columns):
            upper[x], lower[x] = _ONE - abs(state[0, pair, x, 0]), _ONE - abs(state[0, pair, x, 1])
        upper, lower = _pair_of_rows(depth, top + 2 * pair, left, columns, spare)
        for x in range(columns):
            upper[x], lower[x] = state[4, pair, x, 0], state[4, pair, x, 1]
        for channel in range(3):
            upper, lower = _pair_of_rows(color[channel], top + 2 * pair, left, columns, spare)
            background_color = background[channel]
            for x in range(columns):
                upper[x] = state[channel + 1, pair, x, 0] + abs(state[0, pair, x, 0]) * background_color
                lower[x] = state[channel + 1, pair, x, 1] + abs(state[0, pair, x, 1]) * background_color


@njit(**INLINE)
@no_type_check
def _read(state, background, grad_color, grad_alpha, grad_depth, transmittance, left, top, columns, rows):
    """Fill a tile with the initial state of the backward pass: the state behind all Gaussians."""
    if columns < TILE or rows < TILE:
        state[:] = _ZERO
    spare = np.zeros(TILE, np.float32)
    for pair in range((rows + 1) >> 1):
        upper, lower = _pair_of_rows(grad_alpha, top + 2 * pair, left, columns, spare)
        for x in range(columns):
            state[1, pair, x, 0], state[1, pair, x, 1] = -upper[x], -lower[x]
        for channel in range(3):
            upper, lower = _pair_of_rows(grad_color[channel], top + 2 * pair, left, columns, spare)
            background_color = background[channel]
            for x in range(columns):
                state[channel + 2, pair, x, 0], state[channel + 2, pair, x, 1] = upper[x], lower[x]
                state[1, pair, x, 0] += upper[x] * background_color
                state[1, pair, x, 1] += lower[x] * background_color
        upper, lower = _pair_of_rows(grad_depth, top + 2 * pair, left, columns, spare)
        for x in range(columns):
            state[5, pair, x, 0], state[5, pair, x, 1] = upper[x], lower[x]
        upper, lower = _pair_of_rows(transmittance, top + 2 * pair, left, columns, spare)
        for x in range(columns):
            state[0, pair, x, 0], state[0, pair, x, 1] = upper[x], lower[x]
            state[1, pair, x, 0] *= upper[x]
            state[1, pair, x, 1] *= lower[x]


@njit(**INLINE)
@no_type_check
def _pair_of_rows(image, row, left, columns, spare):
    """Return a row of an image inside a tile and the one below it, or `spare` below the image."""
    right = left + columns
    return image[row, left:right], image[row + 1, left:right] if row + 1 < len(image) else spare[:columns]
