"""Which Gaussians touch which tile, nearest first."""

from typing import no_type_check

import numpy as np
from numba import njit

from dg4d_lib.kernels.vectors import INLINE, KERNEL
from dg4d_lib.rasterizer.cpu_project import CENTER_X, CENTER_Y, EXTENT_X, EXTENT_Y

TILE = 64  # pixels of a side; the picture does not depend on it
_DIGIT = 11  # bits of one pass of the radix sort
_BUCKETS = 1 << _DIGIT


@njit(**KERNEL)
@no_type_check
def bin_by_tile(records, keys, across, down):
    """Lists of Gaussians per tile in order of depth; equal depths keep the order of the cloud.

    Returns:
        offsets: tile t has entries offsets[t] to offsets[t + 1]; tiles are counted by rows.
        entries: indices of Gaussians.
    """
    order = _by_depth(keys)
    count = len(order)
    offsets = np.zeros(across * down + 1, np.int64)
    boxes = np.empty((count, 4), np.uint16)
    for i in range(count):
        g = order[i]
        left, right = _tiles_between(records[g, CENTER_X], records[g, EXTENT_X], across)
        top, bottom = _tiles_between(records[g, CENTER_Y], records[g, EXTENT_Y], down)
        boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = left, right, top, bottom
        for row in range(top, bottom):
            for column in range(left, right):
                offsets[row * across + column + 1] += 1
    for tile in range(across * down):
        offsets[tile + 1] += offsets[tile]
    entries = np.empty(offsets[across * down], np.uint32)
    place = offsets[:-1].copy()
    for i in range(count):
        for row in range(boxes[i, 2], boxes[i, 3]):
            for column in range(boxes[i, 0], boxes[i, 1]):
                tile = row * across + column
                entries[place[tile]] = order[i]
                place[tile] += 1
    return offsets, entries


@njit(**INLINE)
@no_type_check
def _tiles_between(center, extent, tiles):
    """First tile and one past the last that hold a pixel center within the extent."""
    scale = np.float32(1 / TILE)
    first = max((center - extent - np.float32(0.5)) * scale, np.float32(0))
    last = min((center + extent - np.float32(0.5)) * scale, np.float32(tiles - 1))
    return int(first), int(max(last, np.float32(0))) + 1


@njit(**KERNEL)
@no_type_check
def _by_depth(keys):
    """Indices of the positive keys, sorted stably: a radix sort of their bits, which order as the floats do."""
    bits = keys.view(np.uint32)
    order = np.empty(len(keys), np.uint32)
    count = 0
    least, most = np.uint32(0xFFFFFFFF), np.uint32(0)
    for i in range(len(keys)):
        if keys[i] > 0:
            order[count] = i
            count += 1
            least, most = min(least, bits[i]), max(most, bits[i])
    order = order[:count]
    other = np.empty(count, np.uint32)
    starts = np.empty(_BUCKETS + 1, np.int64)
    shift = 0
    while count > 0 and (np.int64(most) - np.int64(least)) >> shift > 0:
        starts[:] = 0
        for i in range(count):
            starts[((np.int64(bits[order[i]]) - np.int64(least)) >> shift & (_BUCKETS - 1)) + 1] += 1
        for digit in range(_BUCKETS):
            starts[digit + 1] += starts[digit]
        for i in range(count):
            digit = (np.int64(bits[order[i]]) - np.int64(least)) >> shift & (_BUCKETS - 1)
            other[starts[digit]] = order[i]
            starts[digit] += 1
        order, other = other, order
        shift += _DIGIT
    return order
