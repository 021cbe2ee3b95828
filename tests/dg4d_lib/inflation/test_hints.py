"""Depth of the middle of a body from a turn, a depth picture or layers."""

import math

import numpy as np
import pytest
import torch

from dg4d_lib.errors import BadInput
from dg4d_lib.inflation.heights import heights
from dg4d_lib.inflation.hints import (
    FADE,
    LAYER,
    DepthField,
    DepthHint,
    depth_field,
    layer_field,
    pixel_size,
    turned_plane,
)
from dg4d_lib.inflation.surface import inflate

SIZE = 64
PIXEL = pixel_size(SIZE)
ROWS, COLUMNS = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
MASK = (COLUMNS - 31.5) ** 2 + (ROWS - 31.5) ** 2 < 20**2
ALPHA = MASK.float()
BULGE = torch.from_numpy(heights(MASK.numpy(), PIXEL)).float()
TILT = 0.3 * (COLUMNS - 31.5) * PIXEL
FRONT = TILT + BULGE  # of the disc's body, tilted about the vertical
KNOWN = torch.ones(SIZE, SIZE, dtype=torch.bool)
COVERED = KNOWN.float()


def disc() -> torch.Tensor:
    return torch.stack([ALPHA, 0.5 * ALPHA, 0 * ALPHA, ALPHA], -1)


def error(field: DepthField) -> float:
    """Return the largest difference from the tilted plane, an offset aside."""
    off = (field.middle - TILT)[field.known]
    return float((off - off.mean()).abs().max())


def test_the_plane_of_a_turn_rises_to_the_right() -> None:
    middle, weight = DepthHint(30.0).middle(SIZE)
    assert middle[5, 40] == pytest.approx(math.tan(math.radians(30)) * 8.5 * PIXEL)
    assert np.array_equal(middle, turned_plane(SIZE, 30.0)) and not weight.any()


@pytest.mark.parametrize("unit", [1.0, 250.0])
def test_distances_in_any_unit_give_the_middle_of_the_body(unit: float) -> None:
    field = depth_field(unit * (2 - FRONT), COVERED, ALPHA, "distance")
    assert error(field) < 0.03
    assert abs(float(field.middle[MASK].mean())) < 0.05  # around z = 0


def test_distances_of_an_enlarged_crop_are_as_deep_as_the_subject_is_wide() -> None:
    far = 8 - FRONT  # four times as far away, and cut out four times enlarged
    near = depth_field(2 - FRONT, COVERED, ALPHA, "distance")
    cropped = depth_field(far, COVERED, ALPHA, "distance", enlargement=4.0)
    spans = [float(np.ptp(field.middle[field.known].numpy())) for field in (near, cropped)]
    assert spans[1] == pytest.approx(spans[0], rel=0.25)


def test_inverse_depth_is_known_up_to_scale_and_offset() -> None:
    one, other = (
        depth_field(scale / (2 - FRONT) + offset, COVERED, ALPHA, "inverse")
        for scale, offset in ((1.0, 0.0), (90.0, 7.0))
    )
    assert (one.middle - other.middle).abs().max() < 1e-3
    right, left = one.middle[32, 48], one.middle[32, 15]
    assert float(right - left) > 0.15  # tilted the right way


def test_a_range_of_inverse_depths_is_half_the_smaller_extent() -> None:
    field = depth_field(1 / (2 - TILT), COVERED, ALPHA, "inverse")
    front = (field.middle + BULGE)[field.known].numpy()
    assert np.quantile(front, 0.98) - np.quantile(front, 0.02) == pytest.approx(0.5 * 40 * PIXEL, rel=0.1)


def test_unknown_pixels_take_the_nearest_depth_and_fade_to_the_plane() -> None:
    known = MASK & (COLUMNS < 24)
    hint = DepthHint(0.0, DepthField(torch.where(known, 0.4, 0.0), known, 0.1))
    middle, weight = hint.middle(SIZE)
    assert middle[32, 20] == pytest.approx(0.4) and weight[32, 20] == 1
    gap = 10 * PIXEL / FADE
    assert weight[32, 33] == pytest.approx(math.exp(-(gap**2))) and middle[32, 33] == pytest.approx(
        0.4 * weight[32, 33]
    )
    assert abs(middle[32, 60]) < 1e-3


def test_a_depth_picture_goes_before_a_turn_and_layers_are_added_to_it() -> None:
    field = DepthField(torch.full((SIZE, SIZE), 0.1), KNOWN, 0.1)
    assert np.allclose(DepthHint(20.0, field).middle(SIZE)[0], 0.1)
    layers = DepthField(field.middle, KNOWN)
    assert np.allclose(DepthHint(20.0, layers).middle(SIZE)[0], turned_plane(SIZE, 20.0) + 0.1, atol=1e-6)


def test_a_field_serves_pictures_of_every_size() -> None:
    hint = DepthHint(0.0, depth_field(2 - FRONT, COVERED, ALPHA, "distance"))
    small, _ = hint.middle(32)
    assert small.shape == (32, 32)
    assert small[16, 24] == pytest.approx(float(hint.middle(SIZE)[0][32:34, 48:50].mean()), abs=0.01)


def test_layers_lie_before_and_behind_the_plane() -> None:
    levels = torch.where(COLUMNS < 25, 1.0, torch.where(COLUMNS < 40, 0.5, 0.0))
    field = layer_field(levels, KNOWN, ALPHA)
    assert [round(float(field.middle[32, column]), 6) for column in (20, 32, 45)] == [LAYER, 0, -LAYER]
    assert torch.equal(field.known, MASK) and field.sigma == 0


def test_one_part_painted_on_transparency_is_enough() -> None:
    part = MASK & (COLUMNS < 25)
    assert layer_field(torch.full((SIZE, SIZE), 0.9), part, ALPHA).known.sum() == part.sum()


@pytest.mark.parametrize(
    ("values", "known", "reason"),
    [
        (torch.full((SIZE, SIZE), 3.0), KNOWN, "one value, 3, all over"),
        (FRONT, COLUMNS < 15, "has values for"),
        (FRONT, ~KNOWN, "has values for 0%"),
    ],
)
def test_depth_pictures_that_say_nothing_are_refused(values: torch.Tensor, known: torch.Tensor, reason: str) -> None:
    for kind in ("inverse", "distance"):
        with pytest.raises(BadInput, match=reason):
            depth_field(values, known.float(), ALPHA, kind)


@pytest.mark.parametrize("level", [0.5, 0.9])
def test_layers_of_one_level_are_refused(level: float) -> None:
    with pytest.raises(BadInput, match="one level"):
        layer_field(torch.full((SIZE, SIZE), level), KNOWN, ALPHA)
    with pytest.raises(BadInput, match="transparent"):
        layer_field(torch.full((SIZE, SIZE), level), ~KNOWN, ALPHA)


def test_the_front_of_the_inflated_surface_lies_where_a_depth_picture_shows_it() -> None:
    field = depth_field(2 - FRONT, COVERED, ALPHA, "distance")
    surface = inflate(disc(), SIZE, DepthHint(0.0, field))
    front = surface.vertices[surface.seen]
    across = front[:, 0] / (2 - front[:, 2]) * 2  # in the plane z = 0
    right, left = front[across > 0.2, 2].mean(), front[across < -0.2, 2].mean()
    truth = FRONT[MASK & (COLUMNS > 38)].mean() - FRONT[MASK & (COLUMNS < 25)].mean()
    assert float(right - left) == pytest.approx(float(truth), rel=0.15)
