import math

import pytest
import torch

from dg4d_lib.deformation.interface import Displacement
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.initialize import isotropic
from dg4d_lib.mesh.tracking.reference_frame import (
    edge_stretch,
    evenly_spaced,
    relative_to_frame,
    select_reference_frame,
)
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.settings import MeshSettings


@pytest.mark.parametrize(
    ("total", "count", "expected"), [(14, 3, [0, 6, 13]), (2, 6, [0, 1]), (1, 6, [0]), (6, 6, [0, 1, 2, 3, 4, 5])]
)
def test_even_choices_hold_both_ends(total: int, count: int, expected: list[int]):
    assert evenly_spaced(total, count) == expected


def test_a_motion_told_from_a_frame_is_zero_there():
    values = torch.randn(4, 5, 10, generator=torch.Generator().manual_seed(0))
    motion = relative_to_frame(Displacement(values[..., :3], values[..., 3:6], values[..., 6:]), 2)
    assert not motion.means[2].any() and not motion.quats[2].any() and not motion.log_scales[2].any()
    torch.testing.assert_close(motion.means[3], values[3, :, :3] - values[2, :, :3])


def column(x: float, count: int = 300) -> torch.Tensor:
    places = torch.rand(count, 3, generator=torch.Generator().manual_seed(int(x * 100) + 1000))
    return (places - 0.5) * torch.tensor([0.16, 0.9, 0.16]) + torch.tensor([x, 0.0, 0.0])


@pytest.mark.parametrize(("first_gap", "last_gap", "expected_last"), [(0.0, 0.3, True), (0.3, 0.3, False)])
def test_two_legs_that_part_are_taken_apart_where_they_are_apart(
    first_gap: float, last_gap: float, expected_last: bool
):
    """Legs that touch in the first frame share a surface there; legs that never touch are as good in the first."""
    legs = isotropic(torch.cat([column(0), column(0.0)]), torch.full((600,), 0.04), torch.full((600, 3), 0.5), 0.9)
    sides = torch.cat([-torch.ones(300), torch.ones(300)])[:, None] * torch.tensor([0.5, 0.0, 0.0])
    gaps = 0.16 + torch.linspace(first_gap, last_gap, 4)
    zeros = torch.zeros(4, 600, 3)
    motion = Displacement(gaps[:, None, None] * sides, zeros, torch.zeros(4, 600, 4))
    states = motion.apply(legs)
    assert isinstance(states, Gaussians)
    trial = select_reference_frame(states, motion, get_rasterizer("cpu"), MeshSettings(grid=64))
    assert (trial.frame > 0) == expected_last
    assert trial.iou > 0.8 and trial.stretch < 0.1


def test_gaussians_that_change_places_stretch_the_mesh_and_keep_its_silhouettes():
    """The upper halves of two columns swap sides while the lower halves stay."""
    legs = isotropic(torch.cat([column(-0.2), column(0.2)]), torch.full((600,), 0.04), torch.full((600, 3), 0.5), 0.9)
    upper = (legs.means[:, 1:2] > 0) * torch.cat([torch.ones(300), -torch.ones(300)])[:, None]
    zeros = torch.zeros(3, 600, 3)
    shifts = torch.linspace(0, 1, 3)[:, None, None] * upper * torch.tensor([0.4, 0.0, 0.0])
    motion = Displacement(shifts[[0, 2, 2]], zeros, torch.zeros(3, 600, 4))
    trial = select_reference_frame(motion.apply(legs), motion, get_rasterizer("cpu"), MeshSettings(grid=64))
    assert trial.iou > 0.8 and trial.stretch > 0.2


@pytest.mark.parametrize(("factor", "expected"), [(1.0, 0.0), (2.0, math.log(2)), (0.0, math.log(1000))])
def test_the_stretch_of_a_scaled_turned_triangle_is_the_logarithm_of_its_scale(factor: float, expected: float):
    triangle = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    turned = factor * triangle[:, [1, 2, 0]] + 0.3
    assert edge_stretch(triangle, turned[None], torch.tensor([[0, 1, 2]])) == pytest.approx(expected, abs=1e-5)
