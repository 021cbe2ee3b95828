"""Shape of a subject from its known views."""

import math
from collections.abc import Sequence
from contextlib import suppress

import numpy as np

from dg4d_lib.errors import BadInput
from dg4d_lib.visual_hull.carve import Volume, hull
from dg4d_lib.visual_hull.columns import bounded, fitting_turn
from dg4d_lib.visual_hull.cover import REACH, covering
from dg4d_lib.visual_hull.known import CARVES, KnownView, shows_sides
from dg4d_lib.visual_hull.probable import Predict, probable

CELLS = 128  # along the longest side of the subject
FINEST_CELLS = 192  # likewise, of thin subjects; a cell is about a pixel of the input then
FEW_VERTICES = 40_000  # of a surface: with fewer, cells may be smaller
ALL_AROUND = 12  # known views from which silhouettes alone tell the shape, and limbs are apart
# Tolerances in cells of a grid of `CELLS`; on finer grids they stay the same in world units.
LENIENCE = 0.5  # by which silhouettes of generated views are wider: these are a little wrong
NEARLY = 0.5  # by which a place may violate silhouettes more than the best one behind its pixel


def known_volume(views: Sequence[KnownView], predict: Predict | None = None) -> Volume:
    """Return the hull of a subject, its probable part where views are few, its columns where none shows a side.

    Hulls of many views, whose errors add up, and columns get matter behind every pixel of the input view.

    Args:
        views: of one moment, the input view first.
        predict: tells the shape behind each picture; without it, all that the silhouettes allow is kept.

    Raises:
        BadInput: the views have no common shape.
    """
    carving = _carving(views)
    if leaves_doubt(views):
        volume = hull(carving, CELLS)
        return probable(volume, views, predict) if predict is not None else volume
    if shows_sides([view.camera for view in carving]):
        volume = hull(carving, CELLS, reach=REACH, lenience=LENIENCE)
        return covering(_with_fitting_cells(volume, carving), views[0], NEARLY * volume.step)
    columns = bounded(hull(carving, CELLS, reach=REACH), carving, fitting_turn(carving))
    return covering(columns, views[0], NEARLY * columns.step)


def _with_fitting_cells(volume: Volume, carving: Sequence[KnownView]) -> Volume:
    """Return the hull with smaller cells where `fitting_cells` asks for them."""
    cells = fitting_cells(volume)
    if cells > CELLS:
        with suppress(BadInput):  # the finer grid may miss a hull of which hardly a cell is left
            return hull(carving, cells, reach=REACH, lenience=LENIENCE * cells / CELLS)
    return volume


def fitting_cells(volume: Volume) -> int:
    """Return the number of cells for a subject whose hull has `CELLS`.

    Thin subjects need smaller cells, and their surface is small for their size.
    """
    inside = volume.values > 0
    vertices = sum(int(np.count_nonzero(np.diff(inside, axis=axis))) for axis in range(3))  # of marching cubes
    return round(min(max(CELLS, CELLS * math.sqrt(FEW_VERTICES / max(1, vertices))), FINEST_CELLS))


def leaves_doubt(views: Sequence[KnownView]) -> bool:
    """Return True if views bound the hull on all sides, but are few: a prediction then counts."""
    carving = _carving(views)
    return shows_sides([view.camera for view in carving]) and len(carving) <= ALL_AROUND


def _carving(views: Sequence[KnownView]) -> list[KnownView]:
    return [view for view in views if view.weight >= CARVES]
