"""Shape of a subject from its known views."""

from collections.abc import Sequence

from dg4d_lib.visual_hull.carve import Volume, hull
from dg4d_lib.visual_hull.columns import bounded, fitting_turn
from dg4d_lib.visual_hull.known import CARVES, KnownView, shows_sides
from dg4d_lib.visual_hull.probable import Predict, probable

CELLS = 128  # along the longest side of the subject
ALL_AROUND = 12  # known views from which silhouettes alone tell the shape, and limbs are apart
SIDE_DEG = 50.0  # between views: less leaves the depth open, and the inflation bounds it


def known_volume(views: Sequence[KnownView], predict: Predict | None = None) -> Volume:
    """Return the hull of a subject, or its probable part where views are few.

    Args:
        views: of one moment, the input view first.
        predict: tells the shape behind each picture; without it, all that the silhouettes allow is kept.

    Raises:
        BadInput: the views have no common shape.
    """
    carving = [view for view in views if view.weight >= CARVES]
    volume = hull(carving, CELLS)
    if not shows_sides(carving, SIDE_DEG):
        return bounded(volume, carving, fitting_turn(carving))
    return volume if predict is None or len(carving) > ALL_AROUND else probable(volume, views, predict)
