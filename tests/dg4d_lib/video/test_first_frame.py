"""Correspondence with the first frame: turns are recovered, changed places are not trusted."""

import math

import pytest
import torch

from dg4d_lib.video.first_frame import Correspondence, match_first_frame, strain

SIZE = 64
MIDDLE = (SIZE - 1) / 2
TURN_DEG = 8.0


def turned(angle_deg: float) -> torch.Tensor:
    """Return a premultiplied bar with a smooth pattern, turned about the middle of the picture."""
    rows, columns = (axis - MIDDLE for axis in torch.meshgrid(*[torch.arange(SIZE).float()] * 2, indexing="ij"))
    angle = math.radians(angle_deg)
    y, x = math.cos(angle) * rows - math.sin(angle) * columns, math.sin(angle) * rows + math.cos(angle) * columns
    alpha = ((9.5 - y.abs()).clamp(0, 1) * (21.5 - x.abs()).clamp(0, 1))[None]
    return torch.cat([alpha * (0.5 + 0.4 * torch.sin(x / 3) * torch.cos(y / 3)).expand(3, -1, -1), alpha])


def turned_places(angle_deg: float) -> torch.Tensor:
    """Return row and column at rest of the pixels of a turned picture."""
    rows, columns = (axis - MIDDLE for axis in torch.meshgrid(*[torch.arange(SIZE).float()] * 2, indexing="ij"))
    angle = math.radians(angle_deg)
    y, x = math.cos(angle) * rows - math.sin(angle) * columns, math.sin(angle) * rows + math.cos(angle) * columns
    return torch.stack([y, x], -1) + MIDDLE


def test_a_turn_of_several_frames_is_recovered():
    matches = list(match_first_frame([turned(TURN_DEG * frame) for frame in range(5)]))
    for frame, match in enumerate(matches):
        inside = turned(TURN_DEG * frame)[3] > 0.9
        errors = (match.places - turned_places(TURN_DEG * frame)).norm(dim=-1)[inside]
        assert errors.mean() < 1 and match.trust[inside].mean() > 0.8  # pixels; the turn moves the ends by 12


def test_warping_shows_the_first_frame_as_the_later_one_does():
    match = Correspondence(turned_places(20), torch.ones(SIZE, SIZE))
    assert (match.warp(turned(0)) - turned(20)).abs().mean() < 0.01


@pytest.mark.parametrize(("factor", "expected"), [(1.0, 0.0), (0.5, math.log(2)), (1.25, math.log(1.25))])
def test_strain_is_the_logarithm_of_the_largest_stretch_and_blind_to_turns(factor, expected):
    inside = turned(30)[3] > 0.5
    places = turned_places(30)
    places[..., 1] = (places[..., 1] - MIDDLE) * factor + MIDDLE  # along the bar at rest
    away = torch.where(inside[..., None], places, 0.0)  # what the flow says elsewhere does not count
    found = strain(Correspondence(away, torch.ones(SIZE, SIZE)), inside)
    middle = inside & (turned_places(30) - MIDDLE).norm(dim=-1).lt(6)
    assert (found[middle] - expected).abs().max() < 0.05


@pytest.mark.parametrize("count", [1, 3])
def test_a_still_video_stays_in_place(count):
    matches = list(match_first_frame([turned(0)] * count))
    assert len(matches) == count
    assert (matches[-1].places - matches[0].places).abs().max() < 0.01 and matches[-1].trust.min() > 0.99


def test_what_appears_later_is_not_trusted():
    later = turned(0)
    later[:3, 28:36, 28:36] = torch.tensor([1.0, 0.0, 0.0])[:, None, None]
    later[3, 28:36, 28:36] = 1
    later[:, 2:10, 2:10] = 1  # a second thing
    trust = list(match_first_frame([turned(0), later]))[1].trust
    assert trust[31, 31] < 0.5 and trust[6, 6] < 0.2 and trust[31, 14] > 0.9
