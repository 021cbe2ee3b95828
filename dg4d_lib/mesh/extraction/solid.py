"""Cavities of a density field, and cells whose isosurface is ambiguous.

Samples at or above a level are solid, the others are empty.
"""

import itertools

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from dg4d_lib.mesh.shifts import Slices, shifted

LEAK = 2  # cells; a cavity that opens to the outside only through gaps narrower than twice this is filled

Step = tuple[int, ...]
# Steps to diagonal neighbors on a face and through a cell, one of each two opposite ones
DIAGONALS: tuple[Step, ...] = tuple(
    step for step in itertools.product((-1, 0, 1), repeat=3) if sum(map(abs, step)) > 1 and step > (0, 0, 0)
)


def cavities(solid: Bool[np.ndarray, "i j k"]) -> Bool[np.ndarray, "i j k"]:
    """Mark empty samples that nothing reaches from outside, if balls of `LEAK` cells that fit in close their gaps."""
    marked = np.zeros(solid.shape, bool)
    for body in ndimage.find_objects(solid.view(np.int8)):  # one, or none if nothing is solid
        around = tuple(slice(max(0, side.start - LEAK), side.stop + LEAK) for side in body)  # balls reach so far
        marked[around] = _cavities(solid[around])
    return marked


def _cavities(solid: Bool[np.ndarray, "i j k"]) -> Bool[np.ndarray, "i j k"]:
    padded = np.pad(solid, LEAK + 1)
    thick = _dilate(padded)
    room = ~_outside(thick) & ~thick
    inside = ~_outside(padded | _dilate(room)) & ~padded
    border = slice(LEAK + 1, -LEAK - 1)
    return inside[border, border, border]


def ambiguous(values: Float[np.ndarray, "i j k"], level: float) -> Bool[np.ndarray, "i j k"]:
    """Mark empty samples that must be filled so that no cell of marching cubes is ambiguous.

    A cell is ambiguous where two solid samples, or two empty ones, are diagonal neighbors and nothing of their kind
    lies between them: the interpolation joins or parts them, and noise makes handles. Without such cells, the
    isosurface has the topology of the samples ("well-composed sets", Latecki 1997). Of the samples that would do, the
    densest is marked. Filling them can make other cells ambiguous.
    """
    solid, marked = values >= level, np.zeros(values.shape, bool)
    for step in DIAGONALS:
        ends = [_window(offset, step) for offset in ((0, 0, 0), step)]
        others = [_window(offset, step) for offset in _between(step)]
        joined = np.logical_or.reduce([solid[other] for other in others])
        _mark_densest(marked, values, others, solid[ends[0]] & solid[ends[1]] & ~joined)
        if all(step):  # on a face, both kinds are one
            walled = np.logical_and.reduce([solid[other] for other in others])
            _mark_densest(marked, values, ends, walled & ~solid[ends[0]] & ~solid[ends[1]])
    return marked


def _between(step: Step) -> list[Step]:
    """Return the corners of a face or cube but the two that a diagonal joins."""
    corners = itertools.product(*((0, reach) if reach else (0,) for reach in step))
    return [corner for corner in corners if corner not in ((0, 0, 0), step)]


def _window(offset: Step, step: Step) -> Slices:
    """Return the places at an offset from those whose diagonal lies within the grid."""
    return tuple(
        slice(max(0, -reach) + at, (at - max(0, reach)) or None) for at, reach in zip(offset, step, strict=True)
    )


def _mark_densest(
    marked: Bool[np.ndarray, "i j k"],
    values: Float[np.ndarray, "i j k"],
    places: list[Slices],
    wanted: Bool[np.ndarray, "l m n"],
) -> None:
    """Mark, wherever it is wanted, the first of the places whose value is largest."""
    if wanted.any():
        densest = np.stack([values[place] for place in places]).argmax(0)
        for number, place in enumerate(places):
            marked[place] |= wanted & (densest == number)


def _outside(solid: Bool[np.ndarray, "i j k"]) -> Bool[np.ndarray, "i j k"]:
    """Mark the empty samples connected to the first one."""
    components, _ = ndimage.label(~solid)
    return components == components[0, 0, 0]


def _dilate(solid: Bool[np.ndarray, "i j k"]) -> Bool[np.ndarray, "i j k"]:
    """Mark every sample within `LEAK` steps along the axes of a solid one."""
    for _ in range(LEAK):
        grown = solid.copy()
        for axis, step in itertools.product(range(3), (-1, 1)):
            onto, source = shifted([step * (axis == other) for other in range(3)])
            grown[onto] |= solid[source]
        solid = grown
    return solid
