from dataclasses import replace

import numpy as np
import pytest
import torch
from creatures import alpha_of, creature, icosphere, known_surface, ring, seen

from dg4d_lib.errors import BadInput
from dg4d_lib.metrics.image import iou
from dg4d_lib.visual_hull.carve import hull, margins_of


def test_the_surface_never_leaves_the_hull():
    views = ring(4)
    surface = known_surface(views)
    assert float(margins_of(views, surface.vertices).min()) > -0.02  # a cell of the grid


@pytest.mark.parametrize(("count", "least"), [(4, 0.88), (12, 0.95)])
def test_unseen_views_of_the_hull_agree_with_the_truth(count, least):
    surface = known_surface(ring(count))
    unseen = [iou(alpha_of(surface, azimuth), alpha_of(creature(), azimuth)) for azimuth in (-75, 15, 105, 195)]
    assert float(torch.stack(unseen).mean()) > least


def test_known_views_are_reproduced_with_their_colors():
    views = ring(4)
    surface = known_surface(views)
    for view in views:
        drawn = seen(surface, view.camera.azimuth_deg).cutout
        both = (drawn[..., 3] > 0.99) & (view.cutout[..., 3] > 0.99)
        assert both.sum() > 0.9 * (view.cutout[..., 3] > 0.99).sum()
        assert float((drawn[both] - view.cutout[both])[:, :3].abs().mean()) < 0.03


def test_two_orthogonal_views_of_a_disc_leave_no_corners():
    ball = icosphere(1.0)
    post = replace(ball, vertices=ball.vertices * torch.tensor([0.3, 0.6, 0.3]))
    views = [seen(post, 0), seen(post, 90)]
    corner = torch.tensor([[0.19, 0.0, 0.19], [0.27, 0.0, 0.0]])  # outside of the round post, and inside
    square, rounded = (hull(views, 64, exponent) for exponent in (50.0, 2.0))
    for volume, corners_stay in ((square, True), (rounded, False)):
        cells = (
            corner + torch.tensor([0.05, 0, 0.05]) * torch.tensor([[1.0], [0]]) - torch.tensor(volume.low)
        ) / volume.step
        inside = [bool(volume.values[tuple(cell.round().long().tolist())] > 0) for cell in cells]
        assert inside == [corners_stay, True]


@pytest.mark.parametrize("azimuths", [(0, 90), (0, 90, 180, 270), (0, 60, 120)])
def test_the_hull_of_a_ball_fills_the_silhouettes_that_it_was_carved_from(azimuths):
    """Its top and bottom lie on the outlines of all views, which count one height once."""
    ball = icosphere(0.4)
    views = [seen(ball, azimuth) for azimuth in azimuths]
    drawn = known_surface(views)
    for view in views:
        inside = alpha_of(drawn, view.camera.azimuth_deg)[0, ..., 0] > 0.5
        assert inside[view.cutout[..., 3] > 0.5].float().mean() > 0.97


def test_lenience_widens_the_silhouettes_of_unreliable_views():
    sure = ring(4)
    views = [sure[0], *(replace(view, weight=0.9) for view in sure[1:])]
    np.testing.assert_array_equal(hull(sure, 64, lenience=0.5).values, hull(sure, 64).values)
    one, other = hull(views, 64), hull(views, 64, lenience=0.5)
    near = np.abs(one.values) < one.step  # not truncated
    wider = (other.values - one.values)[near]
    assert wider.min() > -1e-6 and wider.max() < 0.51 * one.step
    assert (wider > 0.49 * one.step).mean() > 0.4  # where the first view, or rounding, bounds the hull, nothing changes


def test_silhouettes_without_a_common_shape_are_refused():
    high, low = seen(creature((0, 0.3, 0)), 0), seen(creature((0, -0.7, 0)), 90)
    cut = high.cutout.clone()
    cut[40:] = 0
    with pytest.raises(BadInput, match="no common shape"):
        known_surface([type(high)(high.camera, cut), low])


def test_an_opposite_view_moves_parts_to_their_depth():
    """Near parts are larger in front, far ones behind: the arm at the back and the leg in front part in depth."""
    surface = known_surface([seen(creature(), 0), seen(creature(), 180)])
    leg = (surface.vertices[:, 1] < -0.45) & (surface.vertices[:, 0].sub(0.1).abs() < 0.1)
    arm = surface.vertices[:, 0] < -0.4
    assert float(surface.vertices[leg, 2].mean()) > 0.1 > -0.05 > float(surface.vertices[arm, 2].mean())
