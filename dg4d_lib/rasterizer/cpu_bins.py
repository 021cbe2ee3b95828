"""Depth-sorted lists of the Gaussians that overlap each tile."""

from typing import Any, no_type_check

import numpy as np
from numpy.typing import NDArray

from dg4d_lib.kernels.compiling import njit
from dg4d_lib.kernels.simd import INLINE, KERNEL
from dg4d_lib.kernels.workers import Scratch
from dg4d_lib.rasterizer.cpu_project import EXTENT_X, EXTENT_Y, MEAN2D_X, MEAN2D_Y

Array = NDArray[Any]

TILE = 64  # pixels of a side; the result does not depend on it
_DIGIT = 12  # bits per pass of the radix sort; the depths of an object differ in at most 24 bits: two passes
_BUCKETS = 1 << _DIGIT
_KEY_SHIFT = np.uint64(32)  # a sort item has the depth in its upper bits and the index in its lower bits
_DIGIT_SHIFT, _DIGIT_MASK, _ONE = np.uint64(_DIGIT), np.uint64(_BUCKETS - 1), np.uint64(1)


def bin_by_tile(records: Array, keys: Array, tiles_x: int, tiles_y: int, scratch: Scratch) -> tuple[Array, Array]:
    """Return the lists of Gaussians per tile, sorted by depth; equal depths keep the order of the cloud.

    Args:
        records: of one view.
        keys: camera z; not positive for Gaussians that are not drawn.
        tiles_x: number of tile columns.
        tiles_y: number of tile rows.
        scratch: allocates the entries.

    Returns:
        offsets: tile t has the entries offsets[t] to offsets[t + 1]; tiles are numbered by rows.
        entries: indices of Gaussians.
    """
    temporary, count = Scratch(), len(keys)
    items, spare = (temporary.empty((count,), np.uint64) for _ in range(2))
    boxes = temporary.empty((count, 4), np.uint16)
    offsets = np.zeros(tiles_x * tiles_y + 1, np.int64)
    count = _list_visible(records, keys, tiles_x, tiles_y, boxes, items, offsets)
    entries = scratch.empty((int(offsets[-1]),), np.uint32)
    _fill(_sorted(items[:count], spare[:count]), boxes, tiles_x, offsets, entries)
    return offsets, entries


@njit(**KERNEL)
@no_type_check
def _list_visible(records, keys, tiles_x, tiles_y, boxes, items, offsets):
    """Fill tile boxes, sort items and list offsets; return the number of items."""
    bits = keys.view(np.uint32)
    count = 0
    for g in range(len(keys)):
        if keys[g] > 0:
            items[count] = np.uint64(bits[g]) << _KEY_SHIFT | np.uint64(g)
            count += 1
            left, right = _tiles_between(records[g, MEAN2D_X], records[g, EXTENT_X], tiles_x)
            top, bottom = _tiles_between(records[g, MEAN2D_Y], records[g, EXTENT_Y], tiles_y)
            boxes[g, 0], boxes[g, 1], boxes[g, 2], boxes[g, 3] = left, right, top, bottom
            for row in range(top, bottom):
                for column in range(left, right):
                    offsets[row * tiles_x + column + 1] += 1
    for tile in range(tiles_x * tiles_y):
        offsets[tile + 1] += offsets[tile]
    return count


@njit(**INLINE)
@no_type_check
def _tiles_between(center, extent, tiles):
    """Return the first and one past the last tile with a pixel center within the extent."""
    scale = np.float32(1 / TILE)
    first = max((center - extent - np.float32(0.5)) * scale, np.float32(0))
    last = min((center + extent - np.float32(0.5)) * scale, np.float32(tiles - 1))
    return int(first), int(max(last, np.float32(0))) + 1


@njit(**KERNEL)
@no_type_check
def _sorted(items, spare):
    """Radix-sort the items and return the array that holds the result.

    The bit patterns of positive floats are ordered as the floats are.
    """
    count = np.uint64(len(items))
    smallest, largest = np.uint64(0xFFFFFFFFFFFFFFFF), np.uint64(0)
    for i in range(count):
        smallest, largest = min(smallest, items[i]), max(largest, items[i])
    smallest = smallest >> _KEY_SHIFT << _KEY_SHIFT
    starts = np.empty(_BUCKETS, np.uint32)
    shift = _KEY_SHIFT
    while count > 0 and largest - smallest >> shift > 0:
        starts[:] = 0
        for i in range(count):
            starts[items[i] - smallest >> shift & _DIGIT_MASK] += np.uint32(1)
        start = np.uint32(0)
        for digit in range(_BUCKETS):
            start, starts[digit] = start + starts[digit], start
        for i in range(count):
            digit = items[i] - smallest >> shift & _DIGIT_MASK
            spare[starts[digit]] = items[i]
            starts[digit] += np.uint32(1)
        items, spare = spare, items
        shift += _DIGIT_SHIFT
    return items


@njit(**KERNEL)
@no_type_check
def _fill(items, boxes, tiles_x, offsets, entries):
    """Write every item into the lists of its tiles."""
    position = offsets[:-1].copy()
    for i in range(len(items)):
        g = np.uint32(items[i])
        for row in range(boxes[g, 2], boxes[g, 3]):
            for column in range(boxes[g, 0], boxes[g, 1]):
                tile = row * tiles_x + column
                entries[position[tile]] = g
                position[tile] += 1
