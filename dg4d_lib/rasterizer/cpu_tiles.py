"""Blending the lists of tiles, and its gradient.

The vectors that cover Gaussians are listed for some Gaussians ahead and then blended in one flat loop (`cpu_blend`);
nested loops over rows would spend their time on mispredicted branches.
"""

from typing import no_type_check

import numpy as np
from numba import njit

from dg4d_lib.kernels.vectors import KERNEL, LANES
from dg4d_lib.rasterizer.cpu_bins import TILE
from dg4d_lib.rasterizer.cpu_blend import (
    BACKWARD_PLANES,
    FORWARD_PLANES,
    MOST_VECTORS,
    OVERRUN,
    PLANE,
    STRIDE,
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
    state = np.empty(FORWARD_PLANES * PLANE, np.float32)
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
    """Add the gradients of the records of tiles first..last to `moments`, row slots[i] for entry i of the lists."""
    height, width = grad_alpha.shape
    across = (width + TILE - 1) // TILE
    state = np.zeros(BACKWARD_PLANES * PLANE, np.float32)
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
                if ends[i] > start:
                    g, slot, place = np.int64(entries[entry]), np.int64(slots[entry]), np.float32(entry - begin)
                    blend_list_backward(
                        state, places, us, vs, start, ends[i], records, g, limits, place, moments, slot
                    )  # fmt: skip
                start = ends[i]
            end -= count


@njit(**KERNEL)
@no_type_check
def gather(entries, parts, moments):
    """Add gradients of single entries to those of their Gaussians, in order of the lists."""
    for i in range(len(entries)):
        g = entries[i]
        for field in range(RECORD):
            moments[g, field] += parts[i, field]


@njit(**KERNEL)
@no_type_check
def _clear(state, columns, rows):
    """Full transmittance inside the picture, stopped from the start outside."""
    state[:PLANE] = -_ONE
    state[PLANE:] = _ZERO
    for y in range(rows):
        base = (y >> 1) * STRIDE + (y & 1)
        for x in range(columns):
            state[base + 2 * x] = _ONE


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


@njit(**KERNEL)
@no_type_check
def _write(state, background, color, alpha, depth, transmittance, left, top, columns, rows):
    for y in range(rows):
        base, row = (y >> 1) * STRIDE + (y & 1), top + y
        for x in range(columns):
            rest = abs(state[base + 2 * x])
            transmittance[row, left + x] = rest
            alpha[row, left + x] = _ONE - rest
        for x in range(columns):
            depth[row, left + x] = state[base + 2 * x + 4 * PLANE]
        for channel in range(3):
            behind = background[channel]
            plane = base + (channel + 1) * PLANE
            for x in range(columns):
                color[channel, row, left + x] = state[plane + 2 * x] + abs(state[base + 2 * x]) * behind


@njit(**KERNEL)
@no_type_check
def _read(state, background, grad_color, grad_alpha, grad_depth, transmittance, left, top, columns, rows):
    if columns < TILE or rows < TILE:
        state[:] = _ZERO
    red, green, blue = background[0], background[1], background[2]
    for y in range(rows):
        base, row = (y >> 1) * STRIDE + (y & 1), top + y
        for x in range(columns):
            i, column = base + 2 * x, left + x
            d_red, d_green, d_blue = grad_color[0, row, column], grad_color[1, row, column], grad_color[2, row, column]
            rest = transmittance[row, column]
            state[i] = rest
            state[i + PLANE] = rest * (d_red * red + d_green * green + d_blue * blue - grad_alpha[row, column])
            state[i + 2 * PLANE] = d_red
            state[i + 3 * PLANE] = d_green
            state[i + 4 * PLANE] = d_blue
            state[i + 5 * PLANE] = grad_depth[row, column]
