"""Metrics of ActionBench on shapes whose distances are known."""

import math

import pytest
import torch
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.metrics.actionbench import (
    Alignment,
    align_points,
    chamfer_3d,
    chamfer_4d,
    chamfer_motion,
    chamfer_sum,
    cube_rotations,
    unit_box,
)

IDENTITY = Alignment(torch.ones(3).double(), torch.eye(3).double(), torch.zeros(3).double())


def shape(count: int = 240) -> Tensor:
    """A solid without symmetry: an L of three boxes of different sizes."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    part = torch.arange(count) % 3
    sizes = torch.tensor([[0.9, 0.2, 0.2], [0.2, 0.7, 0.2], [0.2, 0.2, 0.4]], dtype=torch.float64)
    return points * sizes[part] - 0.2


def turn(degrees: float) -> Tensor:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)


def grid(height: float) -> Tensor:
    x, y = torch.meshgrid(torch.arange(20.0).double(), torch.arange(20.0).double(), indexing="ij")
    return torch.stack([x, y, torch.full_like(x, height)], -1).reshape(-1, 3)


def test_two_planes_are_twice_their_distance_apart() -> None:
    assert chamfer_sum(grid(0), grid(0.3)) == pytest.approx(0.6)
    assert chamfer_sum(grid(0), grid(0)) == 0
    assert chamfer_sum(grid(0), grid(0.3), queries=7) == pytest.approx(0.6)


def test_the_directions_are_added() -> None:
    assert chamfer_sum(grid(0), torch.cat([grid(0), grid(2)])) == pytest.approx(0 + 1)


def test_the_starts_are_the_rotations_of_a_cube() -> None:
    rotations = cube_rotations()
    assert len({tuple(matrix.flatten().tolist()) for matrix in rotations}) == 24
    assert torch.equal(rotations[0], torch.eye(3).double())
    assert (torch.linalg.det(rotations) == 1).all()
    assert torch.equal(rotations @ rotations.mT, torch.eye(3).double().expand(24, 3, 3))


def test_scale_then_rotation_then_translation() -> None:
    alignment = Alignment(torch.tensor([2.0, 1, 1]).double(), turn(90), torch.tensor([0.0, 0, 5]).double())
    assert alignment(torch.tensor([[1.0, 0, 0]]).double())[0].tolist() == pytest.approx([0, 0, 7])


@pytest.mark.parametrize("degrees", [0, 20, 95, 180, 262])
def test_a_pose_and_a_stretch_are_undone(degrees: float) -> None:
    truth = shape()
    stretched = truth * torch.tensor([1.2, 0.9, 1.1]).double()
    moved = stretched @ turn(degrees) + torch.tensor([0.2, -0.1, 0.15]).double()
    alignment = align_points(moved[torch.randperm(len(moved), generator=torch.Generator().manual_seed(1))], truth)
    assert chamfer_sum(alignment(moved), truth) < 0.1 * chamfer_sum(moved, truth) + 1e-3
    assert float((alignment(moved) - truth).norm(dim=-1).mean()) < 0.03  # every point found its own place


def test_poses_that_differ_by_frame_cost_nothing_in_3d_and_much_in_4d() -> None:
    truth = shape()[None].expand(3, -1, -1)
    poses = [Alignment(torch.ones(3).double(), turn(40 * k), torch.zeros(3).double()) for k in range(3)]
    moved = torch.stack([pose(frame) for pose, frame in zip(poses, truth, strict=True)])
    undone = [Alignment(torch.ones(3).double(), turn(-40 * k), torch.zeros(3).double()) for k in range(3)]
    assert chamfer_3d(moved, truth, undone) == pytest.approx(0, abs=1e-9)
    assert chamfer_4d(moved, truth, undone[0]) > 0.05


def test_a_constant_error_of_pose_costs_nothing_in_4d() -> None:
    moving = torch.stack([shape() + torch.tensor([0.1 * k, 0, 0]).double() for k in range(3)])
    align = Alignment(torch.ones(3).double(), turn(-30), torch.zeros(3).double())
    assert chamfer_4d(moving @ turn(30), moving, align) == pytest.approx(0, abs=1e-9)
    assert chamfer_motion(moving @ turn(30), moving, align) == pytest.approx(0, abs=1e-9)


def test_motion_that_is_missing_costs_its_length_in_both_directions() -> None:
    still = grid(0)[None].expand(4, -1, -1)
    moving = torch.stack([grid(0) + torch.tensor([0, 0, 0.2 * k]).double() for k in range(4)])
    assert chamfer_motion(still, moving, IDENTITY) == pytest.approx(2 * 0.2 * (0 + 1 + 2 + 3) / 4)


def test_a_surface_that_slides_within_itself_is_seen_by_motion_alone() -> None:
    """A ring that turns is the same set of points in every frame."""
    angles = torch.arange(360.0).double() * torch.pi / 180
    ring = torch.stack([angles.cos(), angles.sin(), 0 * angles], -1)
    turning = torch.stack([ring.roll(30 * k, 0) for k in range(3)])
    still = ring[None].expand(3, -1, -1)
    assert chamfer_4d(turning, still, IDENTITY) == pytest.approx(0, abs=1e-9)
    chords = [2 * math.sin(math.radians(15 * k)) for k in range(3)]
    assert chamfer_motion(turning, still, IDENTITY) == pytest.approx(2 * sum(chords) / 3)


def test_points_may_be_listed_in_any_order() -> None:
    moving = torch.stack([grid(0), grid(1)])
    order = torch.randperm(400, generator=torch.Generator().manual_seed(0))
    assert chamfer_motion(moving[:, order], moving, IDENTITY) == 0


def test_films_of_different_lengths_have_no_common_motion() -> None:
    with pytest.raises(BadInput, match="given 2 and 3 frames"):
        chamfer_motion(grid(0).expand(2, -1, -1), grid(0).expand(3, -1, -1), IDENTITY)


def test_the_unit_is_the_box_of_the_whole_animation() -> None:
    moving = torch.stack([shape() * 0.3, shape() * 0.3 + 4])
    center, factor = unit_box(moving)
    unit = (moving - center) * factor
    assert unit.amax() == pytest.approx(1) and unit.amin() >= -1 - 1e-9
    sizes = unit.flatten(0, 1).amax(0) - unit.flatten(0, 1).amin(0)
    assert sizes.amax() == pytest.approx(2)
