"""Colored surface of a subject from its known views."""

from collections.abc import Sequence

from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.visual_hull.carve import hull
from dg4d_lib.visual_hull.columns import bounded, fitting_turn
from dg4d_lib.visual_hull.known import KnownView, shows_sides
from dg4d_lib.visual_hull.surface import colored_surface

CELLS = 128  # along the longest side of the subject
SIDE_DEG = 50.0  # between views: less leaves the depth open, and the inflation bounds it


def known_surface(views: Sequence[KnownView]) -> InflatedSurface:
    """Return the colored surface of a subject from views of one moment, the input view first.

    Raises:
        BadInput: the views have no common shape.
    """
    volume = hull(views, CELLS)
    if not shows_sides(views, SIDE_DEG):
        volume = bounded(volume, views, fitting_turn(views))
    return colored_surface(volume, views)
