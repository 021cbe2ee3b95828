import math
from dataclasses import replace

import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.transform import concatenate, thinned, transform
from dg4d_lib.geometry.quaternion import quat_to_rotmat
from dg4d_lib.rasterizer.reference import rasterize

STILL, HERE = torch.tensor([1.0, 0.0, 0.0, 0.0]), torch.zeros(3)


def random_cloud(count: int = 12, states: int = 1) -> Gaussians:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        0.2 * normal(states, count, 3),
        -2.5 + 0.3 * normal(states, count, 3),
        normal(states, count, 4),
        normal(count),
        normal(count, 1, 3),
    )


def test_a_placed_cloud_has_the_moved_means_and_covariances() -> None:
    cloud, quat = random_cloud(states=2).to(torch.float64), torch.tensor([0.5, -0.5, 0.1, 0.7], dtype=torch.float64)
    quat = quat / quat.norm()
    turn, shift = quat_to_rotmat(quat), torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    moved = transform(cloud, quat, 1.5, shift)
    torch.testing.assert_close(moved.means, 1.5 * cloud.means @ turn.mT + shift)
    torch.testing.assert_close(moved.covariances, 2.25 * turn @ cloud.covariances @ turn.mT)


def test_turning_a_cloud_is_walking_around_it() -> None:
    half = math.radians(40) / 2
    turned = transform(random_cloud(), torch.tensor([math.cos(half), 0, math.sin(half), 0]), 1.0, HERE)
    cameras = [OrbitCamera(10, azimuth, width=32, height=32) for azimuth in (0, 40)]
    walked = rasterize(random_cloud(), cameras[:1], HERE)
    seen = rasterize(turned, cameras[1:], HERE)
    torch.testing.assert_close(seen.color, walked.color, atol=1e-5, rtol=0)


def test_a_placing_that_does_nothing_changes_nothing() -> None:
    cloud = random_cloud()
    torch.testing.assert_close(vars(transform(cloud, STILL, 1.0, HERE)), vars(cloud))


def test_joined_clouds_keep_their_gaussians_in_order() -> None:
    first, second = random_cloud(3, states=2), random_cloud(5, states=2)
    both = concatenate([first, second])
    assert len(both) == 8
    assert torch.equal(both.means[:, 3:], second.means)
    assert torch.equal(both.harmonics[:3], first.harmonics)


def test_a_thinned_cloud_covers_the_area_of_the_whole() -> None:
    """Four times fewer Gaussians of twice the size: the sum of the squared scales stays."""
    whole = replace(random_cloud().at(0), log_scales=torch.full((12, 3), -2.5))
    thin = thinned(whole, 4)
    assert torch.equal(thin.means, whole.means[[0, 4, 8]])
    torch.testing.assert_close(thin.scales.square().sum(0), whole.scales.square().sum(0))


def test_colors_that_depend_on_the_view_cannot_be_turned() -> None:
    cloud = replace(random_cloud(), harmonics=torch.zeros(12, 4, 3))
    with pytest.raises(BadInput, match=r"degree 0.*; given degree 1"):
        transform(cloud, STILL, 1.0, HERE)
