"""Hulls of many views, some of them wrong, with matter behind every pixel of the input view."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from creatures import alpha_of, creature, icosphere, ring, seen

from dg4d_lib.metrics.image import iou
from dg4d_lib.visual_hull.carve import TRUNCATION, Volume, hull, margins_of
from dg4d_lib.visual_hull.cover import REACH, covering
from dg4d_lib.visual_hull.known import KnownView
from dg4d_lib.visual_hull.shape import ALL_AROUND, CELLS, FINEST_CELLS, NEARLY, fitting_cells, known_volume
from dg4d_lib.visual_hull.surface import colored_surface

MANY = ALL_AROUND + 4
ERRORS_DEG = (0.0, 8.0, -9.0, 7.0)  # of successive views


@pytest.fixture(scope="module")
def wrong() -> list[KnownView]:
    """Return views all around, three of four at wrong angles."""
    return [
        view.at(0, view.camera.azimuth_deg + ERRORS_DEG[number % len(ERRORS_DEG)])
        for number, view in enumerate(ring(MANY))
    ]


def explained(volume: Volume, view: KnownView) -> float:
    """Return the share of a silhouette that a volume fills."""
    drawn = seen(colored_surface(volume, [view]), view.camera.azimuth_deg).cutout[..., 3] > 0.5
    shown = view.cutout[..., 3] > 0.5
    return float((drawn & shown).sum() / shown.sum())


def test_what_wrong_views_carve_away_comes_back(wrong: list[KnownView]) -> None:
    carved, covered = hull(wrong, CELLS), known_volume(wrong)
    missing, left = 1 - explained(carved, wrong[0]), 1 - explained(covered, wrong[0])
    assert missing > 0.14 and left < 0.85 * missing


def test_it_comes_back_at_its_depth(wrong: list[KnownView]) -> None:
    overlaps = []
    for volume in (hull(wrong, CELLS), known_volume(wrong)):
        surface = colored_surface(volume, wrong[:1])
        views = [iou(alpha_of(surface, azimuth), alpha_of(creature(), azimuth)) for azimuth in (-75, 15, 105, 195)]
        overlaps.append(float(torch.stack(views).mean()))
    assert overlaps[1] > overlaps[0] + 0.02


def test_matter_stays_inside_the_silhouette(wrong: list[KnownView]) -> None:
    volume = known_volume(wrong)
    cells = torch.from_numpy(volume.low) + torch.from_numpy(volume.values > 0).nonzero() * volume.step
    camera = wrong[0].camera
    assert float(margins_of(wrong[:1], cells).min()) > -camera.radius / camera.focal  # a pixel


def test_right_views_need_nothing() -> None:
    views = ring(MANY)
    whole = hull(views, CELLS, reach=REACH)
    covered = covering(whole, views[0], NEARLY * whole.step)
    limit = TRUNCATION * whole.step
    assert np.abs(covered.values).max() <= np.float32(limit)
    assert (covered.values >= whole.values.clip(-limit, limit)).all()
    assert (covered.values > 0).sum() < 1.01 * (whole.values > 0).sum()


def test_cells_of_thin_subjects_are_smaller() -> None:
    ball = icosphere(0.6)
    leaf = replace(ball, vertices=ball.vertices * torch.tensor([1.0, 0.6, 0.02]))
    views = [seen(leaf, 360 * number / MANY, size=256) for number in range(MANY)]
    coarse, fine = hull(views, CELLS, reach=REACH), known_volume(views)
    assert fine.step == pytest.approx(coarse.step * CELLS / FINEST_CELLS)
    unseen = (-80, -50, 35, 100)
    overlaps = [
        float(torch.stack([iou(alpha_of(surface, azimuth), alpha_of(leaf, azimuth)) for azimuth in unseen]).mean())
        for surface in (colored_surface(volume, views) for volume in (coarse, fine))
    ]
    assert overlaps[1] > overlaps[0] + 0.005
    assert fitting_cells(hull(ring(MANY, ball), CELLS, reach=REACH)) == CELLS
