"""Colors across the mirror plane of a subject."""

import math

import pytest
import torch

from dg4d_lib.shape_prior.absorption import optical_density, transmittance
from dg4d_lib.shape_prior.frustum import BINS, FAR, NEAR, SIZE, TAN_HALF_FOV
from dg4d_lib.shape_prior.mirror import MirrorPlane, mirror_plane, mirrored_colors

ROWS, COLUMNS = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
DISTANCE = NEAR + (torch.arange(BINS) + 0.5) * (FAR - NEAR) / BINS
X = (2 * COLUMNS / SIZE - 1)[..., None] * TAN_HALF_FOV * DISTANCE
Y = (1 - 2 * ROWS / SIZE)[..., None] * TAN_HALF_FOV * DISTANCE
Z = (2 - DISTANCE).expand(SIZE, SIZE, BINS)
GRAY = torch.full((SIZE, SIZE, BINS, 3), 0.5)


def mirrored(plane: MirrorPlane, spot_x: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Return hidden colors of a white box with a black stripe at x, and the probability of matter."""
    inside = (X.abs() < 0.4) & (Y.abs() < 0.3) & (Z.abs() < 0.2)
    probability = torch.where(inside, 0.995, 0.001)
    mask = inside.any(-1)
    stripe = ((2 * COLUMNS / SIZE - 1) * TAN_HALF_FOV * 1.8 - spot_x).abs() < 0.05
    front = (1 - stripe.float())[..., None].expand(SIZE, SIZE, 3)
    left = transmittance(optical_density(probability, mask))
    return mirrored_colors(GRAY, front, probability, left, mask, plane), probability


def test_the_back_of_a_box_has_the_stripe_of_its_front():
    plane = MirrorPlane(torch.tensor([0.0, 0, 1]), torch.zeros(3), 1.0)
    colors, probability = mirrored(plane, 0.15)
    back = (probability > 0.5) & (Z < -0.15) & (Y.abs() < 0.2) & (X.abs() < 0.3)
    black, white = back & ((X - 0.15).abs() < 0.02), back & ((X - 0.15).abs() > 0.1)
    assert colors[black].mean() < 0.1 and colors[white].mean() > 0.9


def test_what_the_picture_does_not_show_across_the_plane_keeps_its_color():
    across_x = MirrorPlane(torch.tensor([1.0, 0, 0]), torch.zeros(3), 1.0)  # the mirror image of the back is the back
    colors, probability = mirrored(across_x, 0.15)
    back = (probability > 0.5) & (Z < -0.15)
    assert torch.equal(colors[back], GRAY[back])


def test_a_plane_is_trusted_as_far_as_it_is_sure():
    normal = torch.tensor([math.sin(0.5), 0, math.cos(0.5)])
    sure = mirror_plane(torch.outer(normal, normal), 0.3 * normal, 0.8)
    assert abs(float(sure.normal @ normal)) == pytest.approx(1, abs=1e-5) and sure.trust == pytest.approx(0.8)
    assert float((sure.point - 0.3 * normal).norm()) < 1e-5
    assert mirror_plane(torch.eye(3) / 3, torch.zeros(3), 1.0).trust == 0
    half = mirrored(MirrorPlane(torch.tensor([0.0, 0, 1]), torch.zeros(3), 0.5), 9.0)[0]
    back = (Z < -0.15) & (Z > -0.2) & (Y.abs() < 0.2) & (X.abs() < 0.3)
    assert half[back].max() == pytest.approx(0.75, abs=0.02)
