import math
from dataclasses import replace

import pytest
import torch

from dg4d_lib.deformation.interface import Displacement
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.quaternion import quat_multiply, quat_to_rotmat
from dg4d_lib.mesh.tracking.skinning import skin_vertices


def still(gaussians: Gaussians, times: int) -> Displacement:
    count = len(gaussians)
    return Displacement(torch.zeros(times, count, 3), torch.zeros(times, count, 3), torch.zeros(times, count, 4))


@pytest.fixture
def gaussians() -> Gaussians:
    generator = torch.Generator().manual_seed(3)
    means, quats = torch.rand(300, 3, generator=generator) - 0.5, torch.randn(300, 4, generator=generator)
    log_scales = torch.log(0.02 + 0.05 * torch.rand(300, 3, generator=generator))
    return Gaussians(means, log_scales, quats, torch.randn(300, generator=generator), torch.zeros(300, 1, 3))


@pytest.fixture
def vertices() -> torch.Tensor:
    return torch.rand(200, 3, generator=torch.Generator().manual_seed(4)) - 0.5


def turned(gaussians: Gaussians, quat: torch.Tensor) -> Displacement:
    """All Gaussians turned together about the origin, as one displacement."""
    means = gaussians.means @ quat_to_rotmat(quat).T - gaussians.means
    quats = quat_multiply(quat.expand_as(gaussians.quats), gaussians.quats) - gaussians.quats
    return replace(still(gaussians, 1), means=means[None], quats=quats[None])


def test_a_shift_of_all_gaussians_shifts_every_vertex(gaussians: Gaussians, vertices: torch.Tensor) -> None:
    shift = torch.tensor([[0.1, -0.2, 0.3], [0.0, 0.5, 0.0]])
    displacement = replace(still(gaussians, 2), means=shift[:, None].expand(2, 300, 3))
    offsets = skin_vertices(vertices, gaussians, displacement)
    torch.testing.assert_close(offsets, shift[:, None].expand(2, 200, 3), atol=1e-6, rtol=0)


@pytest.mark.parametrize("degrees", [5.0, 90.0, 170.0])
def test_a_turn_of_all_gaussians_turns_every_vertex(
    gaussians: Gaussians, vertices: torch.Tensor, degrees: float
) -> None:
    half = math.radians(degrees) / 2
    quat = torch.tensor([math.cos(half), 0.6 * math.sin(half), 0.0, 0.8 * math.sin(half)])
    offsets = skin_vertices(vertices, gaussians, turned(gaussians, quat))
    torch.testing.assert_close(vertices + offsets[0], vertices @ quat_to_rotmat(quat).T, atol=1e-5, rtol=0)


def test_nothing_moves_where_no_gaussian_does(gaussians: Gaussians, vertices: torch.Tensor) -> None:
    assert skin_vertices(vertices, gaussians, still(gaussians, 3)).abs().max() < 1e-7


def test_a_single_gaussian_carries_with_its_own_rotation(gaussians: Gaussians, vertices: torch.Tensor) -> None:
    one = gaussians.subset(slice(1))
    quat = torch.tensor([math.cos(0.4), 0.0, math.sin(0.4), 0.0])
    offsets = skin_vertices(vertices, one, turned(one, quat))
    torch.testing.assert_close(vertices + offsets[0], vertices @ quat_to_rotmat(quat).T, atol=1e-5, rtol=0)


def test_a_smooth_bend_is_followed(gaussians: Gaussians, vertices: torch.Tensor) -> None:
    def bent(points: torch.Tensor) -> torch.Tensor:
        angle = 0.8 * points[:, 1]
        x = points[:, 0] * angle.cos() + 0.5 * (1 - angle.cos())
        return torch.stack([x, points[:, 1], points[:, 2] + points[:, 0] * angle.sin()], -1)

    displacement = replace(still(gaussians, 1), means=(bent(gaussians.means) - gaussians.means)[None])
    vertices = 0.7 * vertices  # inside of the cloud
    moved = bent(vertices) - vertices
    error = (skin_vertices(vertices, gaussians, displacement)[0] - moved).norm(dim=-1)
    nearest = torch.cdist(vertices, gaussians.means).argmin(-1)
    error_of_the_nearest = (displacement.means[0, nearest] - moved).norm(dim=-1)
    assert error.mean() < 0.6 * error_of_the_nearest.mean()


def test_two_parts_that_touch_and_part_take_their_own_surface_along() -> None:
    generator = torch.Generator().manual_seed(6)
    means = 0.4 * torch.rand(400, 3, generator=generator) - 0.2
    left = means[:, 0] < 0
    cloud = Gaussians(
        means,
        torch.full((400, 3), math.log(0.03)),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(400, 1),
        torch.full((400,), 2.0),
        torch.zeros(400, 1, 3),
    )
    apart = replace(still(cloud, 2), means=torch.stack([0 * means, torch.where(left[:, None], -0.5, 0.5) + 0 * means]))
    vertices = 0.3 * torch.rand(300, 3, generator=generator) - 0.15
    offsets = skin_vertices(vertices, cloud, apart)[1]
    torch.testing.assert_close(offsets.abs(), torch.full_like(offsets, 0.5), atol=0.02, rtol=0)
    clearly_left, clearly_right = vertices[:, 0] < -0.05, vertices[:, 0] > 0.05
    assert (offsets[clearly_left] < 0).all()
    assert (offsets[clearly_right] > 0).all()


def test_invisible_gaussians_carry_nothing(gaussians: Gaussians, vertices: torch.Tensor) -> None:
    logits = torch.where(torch.arange(300) < 150, 2.0, -9.0)
    means = torch.where(torch.arange(300)[:, None] < 150, 0.0, 5.0)
    faint = replace(gaussians, opacity_logits=logits)
    displacement = replace(still(gaussians, 1), means=means.expand(300, 3)[None])
    assert skin_vertices(vertices, faint, displacement).abs().max() < 1e-6


def test_order_of_the_gaussians_does_not_matter(gaussians: Gaussians, vertices: torch.Tensor) -> None:
    generator = torch.Generator().manual_seed(5)
    displacement = replace(still(gaussians, 1), means=0.1 * torch.randn(1, 300, 3, generator=generator))
    order = torch.randperm(300, generator=generator)
    other = gaussians.subset(order)
    mixed = Displacement(**{name: value[:, order] for name, value in vars(displacement).items()})
    torch.testing.assert_close(
        skin_vertices(vertices, gaussians, displacement), skin_vertices(vertices, other, mixed), atol=1e-6, rtol=0
    )


def test_an_empty_cloud_is_refused(gaussians: Gaussians, vertices: torch.Tensor) -> None:
    empty = gaussians.subset(slice(0))
    with pytest.raises(BadInput, match="non-empty"):
        skin_vertices(vertices, empty, still(empty, 1))
