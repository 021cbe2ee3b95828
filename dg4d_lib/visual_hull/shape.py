"""Colored surface of a subject from its known views."""

from collections.abc import Sequence

from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.visual_hull.carve import Volume, hull
from dg4d_lib.visual_hull.columns import bounded, fitting_turn
from dg4d_lib.visual_hull.known import CARVES, KnownView, shows_sides
from dg4d_lib.visual_hull.surface import colored_surface

CELLS = 128  # along the longest side of the subject
SIDE_DEG = 50.0  # between views: less leaves the depth open, and the inflation bounds it


def known_surface(views: Sequence[KnownView]) -> InflatedSurface:
    """Return the colored surface of a subject from views of one moment, the input view first.

    Raises:
        BadInput: the views have no common shape.
    """
    return colored_surface(known_volume(views), views)


def known_volume(views: Sequence[KnownView]) -> Volume:
    """Return the hull of a subject from views of one moment, the input view first.

    Raises:
        BadInput: the views have no common shape.
    """
    carving = [view for view in views if view.weight >= CARVES]
    volume = hull(carving, CELLS)
    if not shows_sides(carving, SIDE_DEG):
        volume = bounded(volume, carving, fitting_turn(carving))
    return volume
