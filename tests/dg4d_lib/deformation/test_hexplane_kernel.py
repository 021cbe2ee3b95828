"""The fused HexPlane kernel against plain torch in float64."""

import pytest
import torch
from torch.nn import functional

from dg4d_lib.deformation import hexplane_kernel
from dg4d_lib.deformation.hexplane_kernel import hexplane_features

AXES = ((0, 1), (0, 2), (1, 2))


def in_plain_torch(coordinates, planes, lines):
    """Sample every plane with `grid_sample`, a line as a plane of one row."""
    product = 1
    for plane, axes in zip(planes, AXES, strict=True):
        grid = coordinates[None, None, :, list(axes)]
        sample = functional.grid_sample(plane[None], grid, align_corners=True, padding_mode="border")
        product = product * sample[0, :, 0].T
    for axis, line in enumerate(lines):
        place = coordinates[:, axis]
        grid = torch.stack((place, torch.zeros_like(place)), -1).expand(len(line), 1, -1, 2)
        sample = functional.grid_sample(line[:, :, None], grid, align_corners=True, padding_mode="border")
        product = product * sample[:, :, 0].transpose(1, 2)
    return product


def inputs(points, times, channels, size, dtype=torch.float32):
    generator = torch.Generator().manual_seed(5)
    coordinates = 2.4 * torch.rand(points, 3, generator=generator) - 1.2  # some outside
    planes = 0.5 + torch.rand(3, channels, size, size, generator=generator)
    lines = 0.5 + torch.rand(3, times, channels, size, generator=generator)
    return coordinates.to(dtype).requires_grad_(), planes.to(dtype).requires_grad_(), lines.to(dtype).requires_grad_()


@pytest.mark.parametrize(("points", "times", "channels", "size"), [(300, 4, 32, 9), (50, 1, 7, 2), (40, 3, 20, 33)])
def test_features_and_gradients_are_those_of_plain_torch(points, times, channels, size):
    coordinates, planes, lines = inputs(points, times, channels, size)
    found = hexplane_features(coordinates, planes, lines)
    given = (coordinates, planes, lines)
    exact = [value.detach().double().requires_grad_() for value in given]
    truth = in_plain_torch(*exact)
    torch.testing.assert_close(found.double(), truth, rtol=2e-5, atol=1e-6)  # places are rounded to float32 in cells
    cotangent = torch.randn(truth.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    gradients = torch.autograd.grad(found, given, cotangent.float())
    true_gradients = torch.autograd.grad(truth, exact, cotangent)
    for gradient, true_gradient in zip(gradients, true_gradients, strict=True):
        assert (gradient - true_gradient).norm() / true_gradient.norm() < 2e-6


def test_at_the_centers_of_cells_features_are_products_of_their_values():
    _, planes, lines = inputs(1, 2, 5, 3)
    corner_and_middle = torch.tensor([[-1.0, 1.0, 0.0]])  # cells 0, 2 and 1 of x, y and z
    found = hexplane_features(corner_and_middle, planes, lines)[:, 0]
    space = planes[0, :, 2, 0] * planes[1, :, 1, 0] * planes[2, :, 1, 2]
    torch.testing.assert_close(found, space * lines[0, ..., 0] * lines[1, ..., 2] * lines[2, ..., 1])


def test_the_number_of_threads_does_not_change_a_byte():
    coordinates, planes, lines = inputs(1000, 3, 48, 8)
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            found = hexplane_features(coordinates, planes, lines)
            results.append((found, *torch.autograd.grad(found.square().sum(), (coordinates, planes, lines))))
    finally:
        torch.set_num_threads(before)
    assert all(a.equal(b) for result in results[1:] for a, b in zip(result, results[0], strict=True))


def test_large_planes_are_summed_in_fewer_blocks(monkeypatch):
    coordinates, planes, lines = inputs(100, 3, 16, 8)
    found = torch.autograd.grad(hexplane_features(coordinates, planes, lines).sum(), (planes, lines))
    monkeypatch.setattr(hexplane_kernel, "BLOCK_BYTES", 1)
    again = torch.autograd.grad(hexplane_features(coordinates, planes, lines).sum(), (planes, lines))
    for gradient, other in zip(found, again, strict=True):
        torch.testing.assert_close(gradient, other, rtol=1e-5, atol=1e-5)


def test_no_points_have_no_gradient():
    coordinates, planes, lines = inputs(0, 3, 16, 8)
    features = hexplane_features(coordinates, planes, lines)
    assert features.shape == (3, 0, 16)
    assert all((gradient == 0).all() for gradient in torch.autograd.grad(features.sum(), (planes, lines)))


def test_outside_there_is_no_gradient_in_the_coordinates():
    _, planes, lines = inputs(1, 2, 5, 3)
    coordinates = torch.tensor([[0.3, -1.5, 1.1]], requires_grad=True)
    (gradient,) = torch.autograd.grad(hexplane_features(coordinates, planes, lines).sum(), coordinates)
    assert gradient[0, 0] != 0
    assert (gradient[0, 1:] == 0).all()


def test_the_gradients_of_planes_are_the_same_bytes_where_coordinates_want_none():
    coordinates, planes, lines = inputs(100, 3, 16, 8)
    wanted = torch.autograd.grad(hexplane_features(coordinates, planes, lines).sum(), (planes, lines))
    alone = torch.autograd.grad(hexplane_features(coordinates.detach(), planes, lines).sum(), (planes, lines))
    assert all(a.equal(b) for a, b in zip(wanted, alone, strict=True))


def test_coordinates_that_are_not_finite_give_features_that_are_not():
    _, planes, lines = inputs(1, 2, 5, 3)
    assert hexplane_features(torch.full((1, 3), torch.nan), planes, lines).isnan().all()
