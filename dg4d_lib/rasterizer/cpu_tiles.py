"""Blending the lists of tiles, and its gradient.

The vectors that cover Gaussians are listed for some Gaussians ahead and then blended in one flat loop (`cpu_blend`);
nested loops over rows would spend their time on mispredicted branches.
"""

from typing import no_type_check

import numpy as np
from numba import njit

from dg4d_lib.kernels.simd import INLINE, KERNEL, LANES
from dg4d_lib.rasterizer.cpu_bins import TILE
from dg4d_lib.rasterizer.cpu_blend import (
    BACKWARD_PLANES,
    FORWARD_PLANES,
    MOST_VECTORS,
    OVERRUN,
    PLANE,
    PLANE_SHAPE,
    blend_list,
    blend_list_backward,
    cover,
    prefetch,
)
from dg4d_lib.rasterizer.cpu_project import RECORD

NEVER = np.float32(3e9)  # the place in the list where a pixel stopped that did not

_AHEAD = 32  # Gaussians whose vectors are listed before they are blended
_ENOUGH = 512  # vectors after which listing pauses
_LIST = _ENOUGH + MOST_VECTORS + OVERRUN
_ZERO, _ONE = np.float32(0), np.float32(1)


@njit(**KERNEL)
@no_type_check
def blend(
    records, offsets, entries, background, color, alpha, depth, transmittance, stops, stopped, first, last
):  # fmt: skip
    """Draw tiles first..last.

    Also written, for the gradient: the transmittance behind all, whether any pixel of a tile stopped early, and if so
    at which place of the tile's list each pixel did.
    """
    height, width = alpha.shape
    across = (width + TILE - 1) // TILE
    state = np.empty((FORWARD_PLANES, *PLANE_SHAPE), np.float32)
    places, us, vs = np.empty(_LIST, np.int32), np.empty(_LIST, np.float32), np.empty(_LIST, np.float32)
    masks, ends = np.empty(_LIST, np.int32), np.empty(_AHEAD, np.int64)
    for tile in range(first, last):
        left, top = tile % across * TILE, tile // across * TILE
        columns, rows = min(TILE, width - left), min(TILE, height - top)
        begin, end = offsets[tile], offsets[tile + 1]
        stopped[tile] = False
        alive = columns * rows
        _clear(state, columns, rows)
        while begin < end and alive > 0:
            length, count = 0, 0
            while count < _AHEAD and length < _ENOUGH and begin + count < end:
                prefetch(records, np.int64(entries[min(begin + count + 8, end - 1)]) * RECORD)
                g = np.int64(entries[begin + count])
                length = cover(records, g, np.float32(left), np.float32(top), places, us, vs, length)
                ends[count] = length
                count += 1
            start = 0
            for i in range(count):
                g = np.int64(entries[begin + i])
                if blend_list(state, places, us, vs, masks, start, ends[i], records, g) != 0:
                    if not stopped[tile]:
                        stopped[tile] = True
                        stops[tile, :] = NEVER
                    alive -= _note_stops(masks, places, start, ends[i], begin + i - offsets[tile], stops[tile])
                start = ends[i]
            begin += count
        _write(state, background, color, alpha, depth, transmittance, left, top, columns, rows)


@njit(**KERNEL)
@no_type_check
def blend_backward(
    records, offsets, entries, background, grad_color, grad_alpha, grad_depth, transmittance, stops, stopped,
    slots, moments, first, last,
):  # fmt: skip
    """Fill the rows slots[i] of `moments` with the gradients of the records of entries i of tiles first..last."""
    height, width = grad_alpha.shape
    across = (width + TILE - 1) // TILE
    state = np.zeros((BACKWARD_PLANES, *PLANE_SHAPE), np.float32)
    places, us, vs = np.empty(_LIST, np.int32), np.empty(_LIST, np.float32), np.empty(_LIST, np.float32)
    ends = np.empty(_AHEAD, np.int64)
    never = np.full(PLANE, NEVER, np.float32)
    for tile in range(first, last):
        begin, end = offsets[tile], offsets[tile + 1]
        if begin == end:
            continue
        left, top = tile % across * TILE, tile // across * TILE
        columns, rows = min(TILE, width - left), min(TILE, height - top)
        limits = stops[tile] if stopped[tile] else never
        _read(state, background, grad_color, grad_alpha, grad_depth, transmittance, left, top, columns, rows)
        while end > begin:
            length, count = 0, 0
            while count < _AHEAD and length < _ENOUGH and end - count > begin:
                ahead = max(end - count - 9, begin)
                prefetch(records, np.int64(entries[ahead]) * RECORD)
                prefetch(moments, np.int64(slots[ahead]) * RECORD)
                g = np.int64(entries[end - count - 1])
                length = cover(records, g, np.float32(left), np.float32(top), places, us, vs, length)
                ends[count] = length
                count += 1
            start = 0
            for i in range(count):
                entry = end - i - 1
                g, slot, place = np.int64(entries[entry]), np.int64(slots[entry]), np.float32(entry - begin)
                blend_list_backward(state, places, us, vs, start, ends[i], records, g, limits, place, moments, slot)
                start = ends[i]
            end -= count


@njit(**KERNEL)
@no_type_check
def own_rows(entries, count, slots):
    """Rows of moments that no two entries share; gives their number, for which `count + len(entries)` is enough.

    The first entry of Gaussian g has row g, those of other tiles have rows of their own behind all `count`.
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
def gather(entries, slots, count, moments):
    """Add the rows of single entries to those of their Gaussians, in order of the lists."""
    for i in range(len(entries)):
        if slots[i] >= count:
            for field in range(RECORD):
                moments[entries[i], field] += moments[slots[i], field]


@njit(**INLINE)
@no_type_check
def _clear(state, columns, rows):
    """Full transmittance inside the picture, stopped from the start outside."""
    state[0] = -_ONE
    state[1:] = _ZERO
    for pair in range(rows >> 1):
        for x in range(columns):
            state[0, pair, x, 0] = state[0, pair, x, 1] = _ONE
    if rows & 1:
        state[0, rows >> 1, :columns, 0] = _ONE


@njit(**KERNEL)
@no_type_check
def _note_stops(masks, places, start, end, place, stops):
    count = 0
    for j in range(start, end):
        for lane in range(LANES):
            if masks[j] >> lane & 1:
                stops[places[j] + lane] = place
                count += 1
    return count


@njit(**INLINE)
@no_type_check
def _write(state, background, color, alpha, depth, transmittance, left, top, columns, rows):
    """Copy a tile into the picture."""
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
            behind = background[channel]
            for x in range(columns):
                upper[x] = state[channel + 1, pair, x, 0] + abs(state[0, pair, x, 0]) * behind
                lower[x] = state[channel + 1, pair, x, 1] + abs(state[0, pair, x, 1]) * behind


@njit(**INLINE)
@no_type_check
def _read(state, background, grad_color, grad_alpha, grad_depth, transmittance, left, top, columns, rows):
    """Fill a tile with what backward starts from: the state behind all Gaussians."""
    if columns < TILE or rows < TILE:
        state[:] = _ZERO
    spare = np.zeros(TILE, np.float32)
    for pair in range((rows + 1) >> 1):
        upper, lower = _pair_of_rows(grad_alpha, top + 2 * pair, left, columns, spare)
        for x in range(columns):
            state[1, pair, x, 0], state[1, pair, x, 1] = -upper[x], -lower[x]
        for channel in range(3):
            upper, lower = _pair_of_rows(grad_color[channel], top + 2 * pair, left, columns, spare)
            behind = background[channel]
            for x in range(columns):
                state[channel + 2, pair, x, 0], state[channel + 2, pair, x, 1] = upper[x], lower[x]
                state[1, pair, x, 0] += upper[x] * behind
                state[1, pair, x, 1] += lower[x] * behind
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
def _pair_of_rows(picture, row, left, columns, spare):
    """A row of a picture inside a tile and the one below, for which `spare` stands below the picture."""
    right = left + columns
    return picture[row, left:right], picture[row + 1, left:right] if row + 1 < len(picture) else spare[:columns]
