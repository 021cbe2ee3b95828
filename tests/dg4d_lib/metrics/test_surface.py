"""Chamfer distances against known values."""

import math

import pytest
import torch
import trimesh
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.metrics.surface import align_bounding_boxes, chamfer_distance, sample_surface

SQUARE = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), torch.tensor([[0, 1, 2], [0, 2, 3]])
SAMPLES = 20_000
SPACING = 1 / math.sqrt(SAMPLES)


def seed(number: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(number)


def sphere(radius: float) -> tuple[Tensor, Tensor]:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    return torch.from_numpy(ball.vertices).float(), torch.from_numpy(ball.faces)


def chamfer(a: tuple[Tensor, Tensor], b: tuple[Tensor, Tensor], samples: int = SAMPLES) -> float:
    generator = seed()
    return chamfer_distance(sample_surface(*a, samples, generator), sample_surface(*b, samples, generator))


def test_a_plane_and_its_shifted_copy_are_the_shift_apart() -> None:
    vertices, faces = SQUARE
    shifted = vertices + torch.tensor([0.0, 0.0, 0.3])
    assert chamfer((vertices, faces), (shifted, faces)) == pytest.approx(0.3, abs=SPACING**2)


def test_spheres_are_the_difference_of_their_radii_apart() -> None:
    """Nearest points are sampled ones, a little aside: about spacing squared over twice the distance too far."""
    found = chamfer(sphere(0.5), sphere(0.8))
    area = 4 * math.pi * 0.65**2
    assert found == pytest.approx(0.3, abs=area / SAMPLES / 0.3)


def test_equal_surfaces_are_half_a_spacing_apart() -> None:
    """The mean distance to the nearest of randomly spread points (Clark and Evans 1954); the border adds a little."""
    assert chamfer(SQUARE, SQUARE) == pytest.approx(SPACING / 2, rel=0.03)


def test_what_one_surface_lacks_counts_from_that_side_alone() -> None:
    """A square at height 1 above one of two: one side is 1 away, of the other one half is 0 away and one half 1."""
    vertices, faces = SQUARE
    both = torch.cat([vertices, vertices + torch.tensor([0.0, 0.0, 1.0])]), torch.cat([faces, faces + 4])
    found = chamfer((vertices, faces), both)
    assert found == pytest.approx((0 + 0.5) / 2, abs=SPACING)


def test_the_order_of_the_surfaces_does_not_matter() -> None:
    near, far = chamfer(sphere(0.5), sphere(0.6), 2000), chamfer(sphere(0.6), sphere(0.5), 2000)
    assert near == pytest.approx(far, rel=0.01)


def test_how_a_surface_is_cut_into_triangles_does_not_matter() -> None:
    """One corner's triangle is cut into 1000 slivers; as many points lie on it as before."""
    vertices, faces = SQUARE
    edge = torch.linspace(0, 1, 1001)[:, None] * (vertices[2] - vertices[1]) + vertices[1]
    fan = torch.stack([torch.zeros(1000, dtype=torch.long), torch.arange(4, 1004), torch.arange(5, 1005)], 1)
    cut = torch.cat([vertices, edge]), torch.cat([fan, faces[1:]])
    points = sample_surface(*cut, SAMPLES, seed())
    assert float((points[:, 0] > points[:, 1]).double().mean()) == pytest.approx(0.5, abs=4 * 0.5 * SPACING)
    assert points.mean(0).tolist() == pytest.approx([0.5, 0.5, 0], abs=4 * 0.3 * SPACING)


def test_points_depend_on_the_generator_alone() -> None:
    assert torch.equal(sample_surface(*SQUARE, 9, seed(1)), sample_surface(*SQUARE, 9, seed(1)))
    assert not torch.equal(sample_surface(*SQUARE, 9, seed(1)), sample_surface(*SQUARE, 9, seed(2)))


@pytest.mark.parametrize("count", [0, 2])
def test_a_surface_without_area_is_refused(count: int) -> None:
    faces = torch.zeros(count, 3, dtype=torch.long)
    with pytest.raises(BadInput, match=f"a surface of {count} triangles has no area"):
        sample_surface(SQUARE[0], faces, 9, seed())


def test_a_triangle_without_weight_gets_no_points() -> None:
    vertices, faces = SQUARE
    points = sample_surface(vertices, faces, SAMPLES, seed(), torch.tensor([0.0, 0.5]))
    assert (points[:, 1] >= points[:, 0] - 1e-6).all()  # only the second triangle


def test_a_moved_and_grown_crowd_is_put_back_by_the_alignment() -> None:
    target = torch.rand(3, 500, 3, generator=seed(), dtype=torch.float64)
    found = align_bounding_boxes(2.5 * target + torch.tensor([1.0, -2.0, 0.5]), target)
    torch.testing.assert_close(found, target)


def test_the_alignment_is_one_for_all_moments() -> None:
    """A crowd that moves where the target stands still is not held fast."""
    target = torch.rand(1, 500, 3, generator=seed(), dtype=torch.float64).expand(2, -1, -1)
    moving = target + torch.tensor([[[0.0]], [[1.0]]])
    steps = align_bounding_boxes(moving, target).diff(dim=0)
    assert steps.min() > 0.1


def test_points_are_as_far_as_the_mean_of_both_ways() -> None:
    a, b = torch.zeros(1, 3, dtype=torch.float64), torch.tensor([[1.0, 0, 0], [0, 3, 0]], dtype=torch.float64)
    assert chamfer_distance(a, b) == pytest.approx((1 + (1 + 3) / 2) / 2)
