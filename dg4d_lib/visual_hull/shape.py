"""Shape of a subject from its known views."""

from collections.abc import Sequence

from dg4d_lib.visual_hull.carve import Volume, hull
from dg4d_lib.visual_hull.columns import bounded, fitting_turn
from dg4d_lib.visual_hull.known import CARVES, KnownView, shows_sides
from dg4d_lib.visual_hull.probable import Predict, probable

CELLS = 128  # along the longest side of the subject
ALL_AROUND = 12  # known views from which silhouettes alone tell the shape, and limbs are apart


def known_volume(views: Sequence[KnownView], predict: Predict | None = None) -> Volume:
    """Return the hull of a subject, or its probable part where views are few.

    Args:
        views: of one moment, the input view first.
        predict: tells the shape behind each picture; without it, all that the silhouettes allow is kept.

    Raises:
        BadInput: the views have no common shape.
    """
    carving = _carving(views)
    volume = hull(carving, CELLS)
    if not shows_sides([view.camera for view in carving]):
        return bounded(volume, carving, fitting_turn(carving))
    return probable(volume, views, predict) if predict is not None and leaves_doubt(views) else volume


def leaves_doubt(views: Sequence[KnownView]) -> bool:
    """Return True if views bound the hull on all sides, but are few: a prediction then counts."""
    carving = _carving(views)
    return shows_sides([view.camera for view in carving]) and len(carving) <= ALL_AROUND


def _carving(views: Sequence[KnownView]) -> list[KnownView]:
    return [view for view in views if view.weight >= CARVES]
