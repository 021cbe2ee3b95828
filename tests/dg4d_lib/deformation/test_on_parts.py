"""A field on top of rigid parts: the parts move Gaussians rigidly, and the field is added."""

import math

import pytest
import torch

from dg4d_lib.deformation.factory import deformation_of_subset
from dg4d_lib.deformation.framewise import Framewise
from dg4d_lib.deformation.interface import Deformation
from dg4d_lib.deformation.on_parts import OnParts
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.initialize import blob
from dg4d_lib.geometry.quaternion import quat_to_rotmat

COUNT, FRAMES = 40, 3
ANGLES = (0.0, 1.0, 2.0)


@pytest.fixture
def cloud() -> Gaussians:
    return blob(COUNT, 0.5, torch.Generator().manual_seed(0))


def lid(cloud: Gaussians, flip: float = 1.0) -> OnParts:
    """Return a deformation whose upper part turns about x through the origin, and whose lower part shifts along z."""
    owners = (cloud.means[:, 1] > 0).long()
    half = torch.tensor(ANGLES) / 2
    quats = torch.zeros(FRAMES, 2, 4)
    quats[:, 0, 0] = 1
    quats[:, 1, 0], quats[:, 1, 1] = half.cos(), half.sin()
    quats[1] *= flip
    places = torch.zeros(FRAMES, 2, 3)
    places[:, 0, 2] = torch.tensor(ANGLES)
    return OnParts(Framewise(FRAMES, COUNT), owners, cloud.quats, torch.zeros(2, 3), quats, places)


@pytest.mark.parametrize("flip", [1.0, -1.0])  # a quaternion and its negative are one rotation
@pytest.mark.parametrize("time", [0.0, 0.25, 0.5, 0.75, 1.0])
def test_gaussians_move_with_their_part(cloud: Gaussians, flip: float, time: float) -> None:
    moved = lid(cloud, flip).displace(cloud.means, torch.tensor([time])).apply(cloud)
    angle, upper = ANGLES[-1] * time, cloud.means[:, 1] > 0
    turn = quat_to_rotmat(torch.tensor([math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0]))
    torch.testing.assert_close(moved.means[0, upper], cloud.means[upper] @ turn.T, atol=1e-5, rtol=0)
    rotations = quat_to_rotmat(moved.quats[0, upper])
    torch.testing.assert_close(rotations, turn @ quat_to_rotmat(cloud.quats[upper]), atol=1e-5, rtol=0)
    shifted = cloud.means[~upper] + torch.tensor([0.0, 0.0, angle])
    torch.testing.assert_close(moved.means[0, ~upper], shifted, atol=1e-6, rtol=0)


def test_the_field_is_added_and_trained(cloud: Gaussians) -> None:
    deformation, plain = lid(cloud), lid(cloud)
    assert isinstance(deformation, Deformation)
    with torch.no_grad():
        deformation.grid_parameters()[0][1] = 0.1  # the table at the middle frame
    times = torch.tensor([0.5])
    ours, base = (one.displace(cloud.means, times) for one in (deformation, plain))
    for name in ("means", "log_scales", "quats"):
        torch.testing.assert_close(getattr(ours, name), getattr(base, name) + 0.1)
    assert deformation.grid_parameters() == list(deformation.parameters())
    ours.means.sum().backward()
    assert deformation.grid_parameters()[0].grad is not None


def test_a_video_of_one_frame_stays(cloud: Gaussians) -> None:
    owners, quats = torch.zeros(COUNT, dtype=torch.long), torch.tensor([[[1.0, 0, 0, 0]]])
    deformation = OnParts(Framewise(1, COUNT), owners, cloud.quats, torch.zeros(1, 3), quats, torch.zeros(1, 1, 3))
    moved = deformation.displace(cloud.means, torch.tensor([0.0, 1.0])).apply(cloud)
    torch.testing.assert_close(moved.means, cloud.means.expand(2, -1, -1))


def test_a_cloud_without_gaussians_stays_empty() -> None:
    owners, turn, place = torch.zeros(0, dtype=torch.long), torch.tensor([[[1.0, 0, 0, 0]]]), torch.zeros(1, 1, 3)
    deformation = OnParts(Framewise(1, 0), owners, torch.zeros(0, 4), torch.zeros(1, 3), turn, place)
    assert deformation.displace(torch.zeros(0, 3), torch.tensor([0.0, 1.0])).means.shape == (2, 0, 3)


def test_other_gaussians_and_parts_are_refused(cloud: Gaussians) -> None:
    with pytest.raises(BadInput, match="this deformation has 40 Gaussians on its parts; given 39"):
        lid(cloud).displace(cloud.means[1:], torch.zeros(1))
    owners, turn, place = torch.full((COUNT,), 2), torch.ones(1, 2, 4), torch.zeros(1, 2, 3)
    with pytest.raises(BadInput, match="parts from 0 to 1"):
        OnParts(Framewise(1, COUNT), owners, cloud.quats, torch.zeros(2, 3), turn, place)


@pytest.mark.parametrize("on_parts", [False, True])
def test_fewer_gaussians_move_as_before(cloud: Gaussians, on_parts: bool) -> None:
    whole = lid(cloud) if on_parts else Framewise(FRAMES, COUNT, 0.2, torch.Generator().manual_seed(1))
    kept, times = cloud.means[:, 0] > 0, torch.tensor([0.0, 0.3, 1.0])
    fewer = deformation_of_subset(whole, kept).displace(cloud.means[kept], times)
    expected = whole.displace(cloud.means, times)
    for name in ("means", "log_scales", "quats"):
        torch.testing.assert_close(getattr(fewer, name), getattr(expected, name)[:, kept])
