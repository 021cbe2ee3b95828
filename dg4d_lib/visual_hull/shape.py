"""Shape of a subject from its known views."""

from collections.abc import Sequence

from dg4d_lib.visual_hull.carve import Volume, hull
from dg4d_lib.visual_hull.columns import bounded, fitting_turn
from dg4d_lib.visual_hull.cover import REACH, covering
from dg4d_lib.visual_hull.known import CARVES, KnownView, shows_sides
from dg4d_lib.visual_hull.probable import Predict, probable

CELLS = 128  # along the longest side of the subject
ALL_AROUND = 12  # known views from which silhouettes alone tell the shape, and limbs are apart
LENIENCE = 0.5  # cells by which silhouettes of drawn views are wider: these are a little wrong


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
        return covering(hull(carving, CELLS, reach=REACH, lenience=LENIENCE), views[0])
    columns = bounded(hull(carving, CELLS, reach=REACH), carving, fitting_turn(carving))
    return covering(columns, views[0])


def leaves_doubt(views: Sequence[KnownView]) -> bool:
    """Return True if views bound the hull on all sides, but are few: a prediction then counts."""
    carving = _carving(views)
    return shows_sides([view.camera for view in carving]) and len(carving) <= ALL_AROUND


def _carving(views: Sequence[KnownView]) -> list[KnownView]:
    return [view for view in views if view.weight >= CARVES]
