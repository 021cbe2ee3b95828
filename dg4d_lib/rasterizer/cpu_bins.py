"""Which Gaussians touch which tile, nearest first."""

from typing import Any, no_type_check

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dg4d_lib.kernels.simd import INLINE, KERNEL
from dg4d_lib.kernels.workers import Scratch
from dg4d_lib.rasterizer.cpu_project import CENTER_X, CENTER_Y, EXTENT_X, EXTENT_Y

Array = NDArray[Any]

TILE = 64  # pixels of a side; the picture does not depend on it
_DIGIT = 12  # bits of one pass of the radix sort; the depths of an object differ in 24 or fewer, so two passes do
_BUCKETS = 1 << _DIGIT
_KEY_SHIFT = np.uint64(32)  # an item to sort: bits of the depth above, index below
_DIGIT_SHIFT, _DIGIT_MASK, _ONE = np.uint64(_DIGIT), np.uint64(_BUCKETS - 1), np.uint64(1)


def bin_by_tile(records: Array, keys: Array, across: int, down: int, scratch: Scratch) -> tuple[Array, Array]:
    """Lists of Gaussians per tile in order of depth; equal depths keep the order of the cloud.

    Args:
        records: of one view.
        keys: camera z, not positive where nothing is to be drawn.
        across: tiles in a row.
        down: rows of tiles.
        scratch: keeps the entries.

    Returns:
        offsets: tile t has entries offsets[t] to offsets[t + 1]; tiles are counted by rows.
        entries: indices of Gaussians.
    """
    passing, count = Scratch(), len(keys)
    items, spare = (passing.empty((count,), np.uint64) for _ in range(2))
    boxes = passing.empty((count, 4), np.uint16)
    offsets = np.zeros(across * down + 1, np.int64)
    count = _list_shown(records, keys, across, down, boxes, items, offsets)
    entries = scratch.empty((int(offsets[-1]),), np.uint32)
    _fill(_sorted(items[:count], spare[:count]), boxes, across, offsets, entries)
    return offsets, entries


@njit(**KERNEL)
@no_type_check
def _list_shown(records, keys, across, down, boxes, items, offsets):
    """Boxes of tiles, items to sort, and the offsets of the tiles' lists; gives the number of items."""
    bits = keys.view(np.uint32)
    count = 0
    for g in range(len(keys)):
        if keys[g] > 0:
            items[count] = np.uint64(bits[g]) << _KEY_SHIFT | np.uint64(g)
            count += 1
            left, right = _tiles_between(records[g, CENTER_X], records[g, EXTENT_X], across)
            top, bottom = _tiles_between(records[g, CENTER_Y], records[g, EXTENT_Y], down)
            boxes[g, 0], boxes[g, 1], boxes[g, 2], boxes[g, 3] = left, right, top, bottom
            for row in range(top, bottom):
                for column in range(left, right):
                    offsets[row * across + column + 1] += 1
    for tile in range(across * down):
        offsets[tile + 1] += offsets[tile]
    return count


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
def _sorted(items, spare):
    """The items in order, in either of the two arrays: a radix sort; bits of positive floats order as they do."""
    count = np.uint64(len(items))
    least, most = np.uint64(0xFFFFFFFFFFFFFFFF), np.uint64(0)
    for i in range(count):
        least, most = min(least, items[i]), max(most, items[i])
    least = least >> _KEY_SHIFT << _KEY_SHIFT
    starts = np.empty(_BUCKETS, np.uint32)
    shift = _KEY_SHIFT
    while count > 0 and most - least >> shift > 0:
        starts[:] = 0
        for i in range(count):
            starts[items[i] - least >> shift & _DIGIT_MASK] += np.uint32(1)
        start = np.uint32(0)
        for digit in range(_BUCKETS):
            start, starts[digit] = start + starts[digit], start
        for i in range(count):
            digit = items[i] - least >> shift & _DIGIT_MASK
            spare[starts[digit]] = items[i]
            starts[digit] += np.uint32(1)
        items, spare = spare, items
        shift += _DIGIT_SHIFT
    return items


@njit(**KERNEL)
@no_type_check
def _fill(items, boxes, across, offsets, entries):
    """Write every item into the lists of its tiles."""
    place = offsets[:-1].copy()
    for i in range(len(items)):
        g = np.uint32(items[i])
        for row in range(boxes[g, 2], boxes[g, 3]):
            for column in range(boxes[g, 0], boxes[g, 1]):
                tile = row * across + column
                entries[place[tile]] = g
                place[tile] += 1
