"""Placement and judgment of drawn views of a solid whose views are known."""

from dataclasses import replace

import creatures
import pytest
import torch
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.inflation.render import render_surface
from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.visual_hull.adjusting import Scaling
from dg4d_lib.visual_hull.judging import better_direction, judge_views, place_views
from dg4d_lib.visual_hull.known import CARVES, KnownView, known_view

SIZE = 64
FACES = [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4], [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6],
         [1, 3, 5], [3, 7, 5]]  # fmt: skip


def solid() -> InflatedSurface:
    """A long box with a smaller one on its right front corner: no two of its sides are alike; colors follow places."""
    vertices, faces = [], []
    for low, high in (((-0.3, -0.35, -0.4), (0.3, 0.2, 0.4)), ((0.05, 0.2, 0.1), (0.3, 0.5, 0.38))):
        faces += [[4 * 0 + 8 * (len(vertices) // 8) + i for i in face] for face in FACES]
        vertices += [[(low, high)[i >> axis & 1][axis] for axis in (2, 1, 0)][::-1] for i in range(8)]
    places = torch.tensor(vertices)
    return InflatedSurface(places, torch.tensor(faces), (places + 0.6) / 1.2, torch.ones(len(places), dtype=torch.bool))


def seen(azimuth: float, elevation: float = 0.0) -> KnownView:
    camera = OrbitCamera(elevation, azimuth, width=SIZE, height=SIZE)
    color, alpha = render_surface(solid(), [camera])
    return known_view(torch.cat([color[0].clamp(0, 1), alpha[0]], -1), azimuth, elevation)


@pytest.fixture(scope="module")
def ring() -> list[KnownView]:
    return [seen(azimuth) for azimuth in range(0, 360, 45)]


def spoiled(views: list[KnownView], index: int, cutout: Tensor) -> list[KnownView]:
    return [*views[:index], replace(views[index], cutout=cutout), *views[index + 1 :]]


def test_true_views_have_full_weight(ring: list[KnownView]) -> None:
    assert min(one.weight for one in judge_views(ring[0], ring[1:])) > 0.85


@pytest.mark.slow
def test_an_outline_that_contradicts_the_others_weighs_little_and_the_others_keep_theirs(ring: list[KnownView]) -> None:
    views = spoiled(ring[1:], 3, ring[4].cutout.flip(0))
    found = judge_views(ring[0], views)
    assert found[3].outline < 0.4 and found[3].weight < CARVES
    assert min(one.weight for i, one in enumerate(found) if i != 3) > CARVES


@pytest.mark.slow
def test_colors_that_contradict_the_others_weigh_little(ring: list[KnownView]) -> None:
    wrong = torch.cat([1 - ring[3].cutout[..., :3], ring[3].cutout[..., 3:]], -1)
    found = judge_views(ring[0], spoiled(ring[1:], 2, wrong))
    assert found[2].color < 0.6 and found[2].outline > 0.85
    assert found[2].weight == min(one.weight for one in found)


def test_azimuths_counted_the_other_way_are_found_and_true_ones_stay(ring: list[KnownView]) -> None:
    turned = [view.at(0, -view.camera.azimuth_deg % 360) for view in ring[1:]]
    views, mirrored = better_direction(ring[0], turned)
    assert mirrored and [v.camera.azimuth_deg for v in views] == [v.camera.azimuth_deg for v in ring[1:]]
    assert not better_direction(ring[0], ring[1:])[1]


def test_views_of_any_scale_get_that_of_the_input_also_from_above(ring: list[KnownView]) -> None:
    above = seen(90, 30)
    given = [*ring[1:], above]
    scaled = [replace(v, cutout=Scaling(0.7, 0, 3).apply(v.cutout, 0, SIZE)) for v in given]
    for placed, true in zip(place_views(ring[0], scaled), given, strict=True):
        mask, truth = placed.cutout[..., 3] > 0.5, true.cutout[..., 3] > 0.5
        assert float((mask & truth).sum() / (mask | truth).sum()) > 0.7, true.camera  # heights differ by perspective


def test_two_pictures_cannot_be_judged(ring: list[KnownView]) -> None:
    assert judge_views(ring[0], ring[4:5])[0].weight == 1


def test_true_views_of_thin_legs_have_full_weight(monkeypatch: pytest.MonkeyPatch) -> None:
    legs = [((x, -0.45, z), (0.018, 0.3, 0.018), (0.2, 0.6, 0.6)) for x in (-0.1, 0.12) for z in (-0.3, 0.25)]
    monkeypatch.setattr(creatures, "PARTS", (*creatures.PARTS[:2], *legs))
    views = creatures.ring(6)
    assert min(one.outline for one in judge_views(views[0], views[1:])) > 0.85
