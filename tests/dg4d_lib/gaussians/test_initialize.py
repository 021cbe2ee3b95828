import pytest
import torch

from dg4d_lib.gaussians.initialize import blob, on_surface


def test_a_blob_fills_its_ball_with_grey():
    cloud = blob(5000, 0.5, torch.Generator().manual_seed(0))
    radii = cloud.means.norm(dim=-1)
    assert radii.max() <= 0.5
    assert abs((radii < 0.25).float().mean() - 1 / 8) < 0.02  # volume goes with the cube
    torch.testing.assert_close(cloud.colors, torch.full((5000, 3), 0.5))
    torch.testing.assert_close(cloud.opacities, torch.full((5000,), 0.1))
    assert abs(float(cloud.scales.mean()) - 0.035) < 0.003  # the size that the public code gets for 5,000 points


def test_surface_points_cover_their_area():
    points = torch.rand(100, 3, generator=torch.Generator().manual_seed(0))
    cloud = on_surface(points, points, area=4.0)
    torch.testing.assert_close(cloud.scales, torch.full((100, 3), 0.2))
    torch.testing.assert_close(cloud.colors, points)
    torch.testing.assert_close(cloud.means, points)
    torch.testing.assert_close(cloud.opacities, torch.full((100,), 0.9))


def test_coincident_points_still_have_a_size():
    cloud = on_surface(torch.zeros(5, 3), torch.zeros(5, 3), area=0.0)
    assert torch.isfinite(cloud.log_scales).all()
    cloud = blob(5, 0.0, torch.Generator().manual_seed(0))
    assert torch.isfinite(cloud.log_scales).all()


@pytest.mark.parametrize("count", [2, 3, 4])
def test_small_clouds_are_scaled_by_the_neighbors_that_exist(count: int):
    cloud = blob(count, 0.5, torch.Generator().manual_seed(0))
    between = torch.cdist(cloud.means, cloud.means).square().sum(1) / (count - 1)
    torch.testing.assert_close(cloud.scales[:, 0], between.sqrt())
