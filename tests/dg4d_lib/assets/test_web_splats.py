"""Web splats: round trip within the documented errors."""

from dataclasses import replace

import pytest
import torch
from splat_readers import read_web_splats

from dg4d_lib.assets.formats.web_splats import (
    POSITION_STEPS,
    ROTATION_STEP,
    SCALE_STEP,
    write_web_splats,
)
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.quaternion import quat_to_rotmat
from dg4d_lib.geometry.spherical_harmonics import rgb_to_sh


def cloud(frames: int = 6, count: int = 50, seed: int = 0) -> Gaussians:
    """A cloud whose colors tell its Gaussians apart; they drift, turn by any angle and change size."""
    generator = torch.Generator().manual_seed(seed)
    drift = torch.randn(frames, count, 3, generator=generator) / 20
    number = torch.arange(count)
    colors = torch.stack([number % 256, number // 256, torch.full((count,), 9)], 1) / 255
    return Gaussians(
        torch.randn(count, 3, generator=generator) * torch.tensor([1.0, 0.4, 0.1]) + drift.cumsum(0) + 7,
        torch.randn(frames, count, 3, generator=generator) - 4,
        torch.randn(frames, count, 4, generator=generator),
        torch.randn(count, generator=generator) * 3,
        rgb_to_sh(colors),
    )


def back(states: Gaussians, fps: float = 12.0) -> Gaussians:
    """Decode the file and restore the order of the Gaussians."""
    read, _ = read_web_splats(write_web_splats(states, fps))
    colors = (read.colors * 255).round().long()
    order = torch.argsort(colors[:, 0] + 256 * colors[:, 1])
    moving = (read.means[:, order], read.log_scales[:, order], read.quats[:, order])
    return Gaussians(*moving, read.opacity_logits[order], read.harmonics[order])


def angles_between(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """Of the turn from one rotation to another, radians."""
    turn = quat_to_rotmat(first.double()).mT @ quat_to_rotmat(second.double())
    return ((turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1).acos()


def test_positions_are_off_by_less_than_an_8192nd_of_the_box() -> None:
    given = cloud()
    side = (given.means.amax((0, 1)) - given.means.amin((0, 1))).max()
    rounding = 4 * torch.finfo(torch.float32).eps * given.means.abs().max()
    error = (back(given).means - given.means).abs().max()
    assert side / POSITION_STEPS / 4 < error < side / 8192 + rounding


def test_rotations_are_off_by_less_than_the_diagonal_of_half_a_step() -> None:
    given = cloud()
    error = angles_between(given.quats, back(given).quats)
    assert ROTATION_STEP / 4 < error.max() < 3**0.5 / 2 * ROTATION_STEP + 1e-5


def test_scales_are_off_by_less_than_half_a_step_and_color_and_opacity_too() -> None:
    given = cloud()
    read = back(given)
    assert (read.log_scales - given.log_scales).abs().max() <= SCALE_STEP / 2 + 1e-6
    assert (read.colors - given.colors).abs().max() < 1e-6  # they are whole numbers of 1/255
    assert (read.opacities - given.opacities).abs().max() < 0.5 / 255 + 1e-6


def test_what_was_read_is_written_again_without_loss() -> None:
    read, fps = read_web_splats(write_web_splats(cloud(), 23.976))
    again, _ = read_web_splats(write_web_splats(read, fps))
    assert fps == 23.976
    for name, value in vars(again).items():
        torch.testing.assert_close(value, getattr(read, name), rtol=0, atol=1e-4)


def test_equal_clouds_give_equal_bytes_and_the_sign_of_a_quaternion_does_not_count() -> None:
    given = cloud()
    content = write_web_splats(given, 12.0)
    signs = torch.where(torch.rand(given.quats.shape[:2], generator=torch.Generator().manual_seed(3)) < 0.5, -1.0, 1.0)
    turned = replace(given, quats=given.quats * signs[..., None])
    assert write_web_splats(cloud(), 12.0) == content
    assert write_web_splats(turned, 12.0) == content


def test_the_order_of_the_gaussians_does_not_matter() -> None:
    given, order = cloud(), torch.randperm(50, generator=torch.Generator().manual_seed(1))
    moving = (given.means[:, order], given.log_scales[:, order], given.quats[:, order])
    shuffled = Gaussians(*moving, given.opacity_logits[order], given.harmonics[order])
    assert write_web_splats(shuffled, 12.0) == write_web_splats(given, 12.0)


def test_what_does_not_move_costs_next_to_nothing() -> None:
    still = cloud(frames=1, count=1000)
    held = still.states([0] * 30)
    assert len(write_web_splats(held, 12.0)) < len(write_web_splats(still, 12.0)) + 1500


def test_neighbors_that_move_alike_cost_less_than_a_third_of_their_numbers() -> None:
    frames, count = 14, 2000
    rest = torch.randn(count, 3, generator=torch.Generator().manual_seed(0)) / 3
    time = torch.arange(frames)[:, None] / frames * 2 * torch.pi
    sway = torch.sin(time + rest[:, 0]) * 0.2
    means = rest + sway[..., None] * torch.tensor([1.0, 0.5, 0.2])
    quats = torch.stack([torch.cos(sway), torch.zeros_like(sway), torch.sin(sway), torch.zeros_like(sway)], -1)
    states = replace(cloud(frames, count), means=means, quats=quats, log_scales=torch.full((frames, count, 3), -4.0))
    assert len(write_web_splats(states, 12.0)) < frames * count * 18 / 3


@pytest.mark.parametrize(("frames", "count"), [(1, 1), (1, 7), (9, 1)])
def test_the_smallest_clouds_come_back(frames: int, count: int) -> None:
    given = cloud(frames, count)
    torch.testing.assert_close(back(given).means, given.means, rtol=0, atol=1e-3)  # of 5 units


def test_a_cloud_in_one_point_comes_back() -> None:
    given = replace(cloud(), means=torch.full((6, 50, 3), 0.25))
    torch.testing.assert_close(back(given).means, given.means)


@pytest.mark.parametrize(
    ("faulty", "word"),
    [
        (cloud().at(0), r"\(t, n, 3\)"),
        (cloud().states([]), "at least one"),
        (replace(cloud(), means=torch.full((6, 50, 3), torch.nan)), "finite"),
        (replace(cloud(), opacity_logits=torch.full((50,), torch.inf)), "finite"),
    ],
)
def test_what_cannot_be_written_is_refused(faulty: Gaussians, word: str) -> None:
    with pytest.raises(BadInput, match=word):
        write_web_splats(faulty, 12.0)


@pytest.mark.parametrize("fps", [0.0, -1.0, float("nan"), float("inf")])
def test_a_rate_that_is_none_is_refused(fps: float) -> None:
    with pytest.raises(BadInput, match="frames per second"):
        write_web_splats(cloud(), fps)
