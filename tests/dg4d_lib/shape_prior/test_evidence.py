"""Log-odds from hints at the depth of a subject."""

import numpy as np
import pytest
import torch
from tiny_shape_prior import tiny_network

from dg4d_lib.inflation.heights import heights
from dg4d_lib.inflation.hints import DepthField, DepthHint
from dg4d_lib.shape_prior.evidence import (
    BEHIND,
    DEPTHS,
    FRONT,
    PLANE_SIGMA,
    front_evidence,
    hint_evidence,
    middle_evidence,
    own_middle,
)
from dg4d_lib.shape_prior.field import ShapeFields
from dg4d_lib.shape_prior.frustum import BINS, SIZE, TAN_HALF_FOV
from dg4d_lib.shape_prior.surface import decided_surface

MASK = torch.zeros(SIZE, SIZE, dtype=torch.bool)
MASK[30:100, 20:110] = True


def bump(middle: float, half: float = 0.2) -> torch.Tensor:
    """Return logits of a slab."""
    inside = torch.from_numpy(np.abs(DEPTHS - middle) < half)
    return torch.where(inside, 4.0, -9.0).expand(SIZE, SIZE, BINS)


def test_no_hint_and_a_hint_at_what_the_network_says_change_nothing() -> None:
    logits = bump(0.0)
    assert not hint_evidence(DepthHint(), logits, MASK).any()
    same = DepthHint(0.0, DepthField(torch.zeros(SIZE, SIZE), MASK))
    assert hint_evidence(same, logits, MASK)[MASK].abs().max() < 1e-6


def test_a_level_plane_is_evidence() -> None:
    assert hint_evidence(DepthHint(0.0), bump(0.3), MASK)[MASK].abs().max() > 1


def test_evidence_of_the_middle_is_a_ratio_of_gaussians() -> None:
    found = middle_evidence(np.full((1, 1), 0.2), np.full((1, 1), -0.1))[0, 0]
    expected = ((DEPTHS + 0.1) ** 2 - (DEPTHS - 0.2) ** 2) / (2 * PLANE_SIGMA**2)
    assert np.allclose(found, expected)


def test_the_middle_of_the_matter_is_found() -> None:
    assert own_middle(bump(0.3, 0.1), MASK.numpy())[60, 60] == pytest.approx(0.3, abs=0.03)


def test_a_known_surface_has_nothing_before_it_and_matter_behind_it() -> None:
    found = front_evidence(np.full((1, 1), 0.1), np.full((1, 1), 0.3), 0.03)[0, 0]
    deep = 0.1 - DEPTHS
    assert np.allclose(found[deep < -0.1], -FRONT, atol=0.1)
    assert found[np.argmin(np.abs(deep - 0.06))] == pytest.approx(0.8 * FRONT, rel=0.1)
    assert (np.diff(found[deep > 0.05]) <= 1e-9).all() and found[-1] == pytest.approx(-BEHIND)


def test_the_first_surface_moves_to_the_hinted_depth() -> None:
    picture = torch.zeros(SIZE, SIZE, 4)
    picture[50:80, 55:75] = torch.tensor([0.5, 0.2, 0.1, 1.0])
    known = picture[..., 3] > 0
    for place in (-0.3, 0.3):
        hint = DepthHint(0.0, DepthField(torch.full((SIZE, SIZE), place), known, 0.03))
        logits = ShapeFields(tiny_network(), [picture], hint).predict(0).logits[65, 65]
        half = heights(known.numpy(), 4 * TAN_HALF_FOV / SIZE)[65, 65]
        first = float(DEPTHS[int((logits > 0).int().argmax())])
        assert first == pytest.approx(place + half, abs=0.05)


def test_a_leg_behind_a_body_goes_on_behind_it() -> None:
    middle = torch.full((SIZE, SIZE), 0.3)
    middle[75:, 60:66] = -0.3  # the leg, and a body whose back lies before it
    mask = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    mask[60:76, 20:110] = mask[75:100, 60:66] = True
    found = hint_evidence(DepthHint(0.0, DepthField(middle, mask, 0.03)), bump(0.0), mask)
    between = int(np.argmin(np.abs(DEPTHS + 0.05)))
    assert found[74, 63, between] > 0 > found[74, 25, between]


def test_surfaces_out_of_the_frustum_leave_no_ray_empty() -> None:
    picture = torch.zeros(SIZE, SIZE, 4)
    picture[MASK] = torch.tensor([0.5, 0.2, 0.1, 1.0])
    for place in (-1.0, 1.0):
        hint = DepthHint(0.0, DepthField(torch.full((SIZE, SIZE), place), MASK, 0.03))
        field = ShapeFields(tiny_network(), [picture], hint).predict(0)
        assert decided_surface(field).vertices.isfinite().all()


def test_turns_to_both_sides_are_mirror_images() -> None:
    logits = torch.zeros(SIZE, SIZE, BINS)
    whole = torch.ones(SIZE, SIZE, dtype=torch.bool)
    right, left = (hint_evidence(DepthHint(turn), logits, whole) for turn in (30.0, -30.0))
    torch.testing.assert_close(right, left.flip(1))
