import pytest
import torch

from dg4d_lib.deformation.interface import Displacement
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.initialize import isotropic
from dg4d_lib.mesh.tracking.reference_frame import evenly_spaced, relative_to_frame, select_reference_frame
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
    frame, agreement = select_reference_frame(states, motion, get_rasterizer("cpu"), MeshSettings(grid=64))
    assert (frame > 0) == expected_last
    assert agreement > 0.8
