"""Interpolation between frames and from the last frame to the first."""

from functools import partial

import pytest
import torch

from dg4d_lib.assets.animated import interpolate_frames, pose_gaussians, states_between
from dg4d_lib.deformation.framewise import Framewise
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.quaternion import quat_to_rotmat


def test_positions_on_frames_are_the_frames_of_the_deformation(red_dot: Gaussians, slide: Framewise) -> None:
    states = pose_gaussians(red_dot, slide, 5, torch.arange(5.0))
    assert states.means[:, 0, 0].tolist() == [0, 0.125, 0.25, 0.375, 0.5]


def test_the_animation_returns_from_the_last_frame_to_the_first(red_dot: Gaussians, slide: Framewise) -> None:
    states = pose_gaussians(red_dot, slide, 5, torch.tensor([4.0, 4.25, 4.5, 5.0]))
    assert states.means[:, 0, 0].tolist() == [0.5, 0.375, 0.25, 0.0]
    torch.testing.assert_close(states.log_scales[-1], red_dot.log_scales)


@pytest.mark.parametrize("stored", [False, True])
def test_a_full_turn_goes_on_where_it_closes(red_dot: Gaussians, stored: bool) -> None:
    """Turned by 300 degrees, the quaternion is nearer to the negative of the first one."""
    angles = torch.tensor([0.0, 100.0, 200.0, 300.0]).deg2rad() / 2
    turn = Framewise(4, 1).requires_grad_(False)
    turn.table[:, 0, 6], turn.table[:, 0, 9] = angles.cos() - 1, angles.sin()
    posed = partial(pose_gaussians, red_dot, turn, 4)
    if stored:
        posed = partial(states_between, posed(torch.arange(4.0)))
    found = quat_to_rotmat(posed(torch.tensor([3.0, 3.5, 4.0])).quats[:, 0])
    expected = torch.tensor([300.0, 330.0, 360.0]).deg2rad()
    torch.testing.assert_close(found[:, 0, 0], expected.cos(), atol=1e-6, rtol=0)
    torch.testing.assert_close(found[:, 1, 0], expected.sin(), atol=1e-6, rtol=0)


def test_a_motion_of_one_frame_stands_still(red_dot: Gaussians, slide: Framewise) -> None:
    assert pose_gaussians(red_dot, slide, 1, torch.tensor([0.0, 0.5, 1.0])).means.abs().max() == 0


def test_values_between_frames_are_linear_and_the_last_is_followed_by_the_first() -> None:
    values = torch.tensor([0.0, 1.0, 4.0]).view(3, 1, 1)
    positions = torch.tensor([0.0, 0.5, 1.0, 1.25, 2.0, 2.5, 3.0])
    assert interpolate_frames(values, positions).flatten().tolist() == [0, 0.5, 1, 1.75, 4, 2, 0]


@pytest.mark.parametrize("positions", [[0.0, 1.0, 2.0, 3.0]])
def test_whole_positions_give_the_stored_values_exactly(positions: list[float]) -> None:
    values = torch.randn(4, 5, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(interpolate_frames(values, torch.tensor(positions, dtype=torch.float64)), values)
