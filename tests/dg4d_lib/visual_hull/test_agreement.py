import torch
from creatures import creature, ring, seen

from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.visual_hull.agreement import agreement, hull_alpha, turntable_score
from dg4d_lib.visual_hull.known import KnownView


def test_views_of_one_subject_fill_the_silhouettes_of_each_other():
    found = agreement(ring(4))
    assert min(found.filled) > 0.95 and found.odd is None


def test_the_view_of_something_else_is_found():
    views = ring(4)
    strange = creature()
    wide = InflatedSurface(strange.vertices * torch.tensor([1.0, 0.4, 1.0]), *list(vars(strange).values())[1:])
    views[2] = seen(wide, 180)
    found = agreement(views)
    assert found.odd == 2 and min(found.filled) < 0.8


def test_the_direction_of_a_turntable_is_told_by_colors_and_perspective():
    views = ring(12)
    reverse = [view.at(0, -view.camera.azimuth_deg) for view in views]
    assert turntable_score(views) > turntable_score(reverse) + 0.05


def test_silhouettes_that_exclude_each_other_score_nothing():
    front, side = ring(4)[:2]
    head, foot = front.cutout.clone(), side.cutout.clone()
    head[24:], foot[:72] = 0, 0
    assert turntable_score([KnownView(front.camera, head), KnownView(side.camera, foot)]) == 0


def test_the_silhouette_of_a_hull_is_seen_from_any_camera():
    between = seen(creature(), 30)
    (alpha,) = hull_alpha(ring(6), [between.camera])
    mask, truth = alpha > 0.5, between.cutout[..., 3:] > 0.5
    assert float((mask & truth).sum() / (mask | truth).sum()) > 0.85
