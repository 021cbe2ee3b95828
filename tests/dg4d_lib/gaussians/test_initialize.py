import math

import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.gaussians.initialize import blob, on_surface
from dg4d_lib.geometry.quaternion import quat_to_rotmat
from dg4d_lib.rasterizer.interface import get_rasterizer


def test_a_blob_fills_its_ball_with_grey():
    cloud = blob(5000, 0.5, torch.Generator().manual_seed(0))
    radii = cloud.means.norm(dim=-1)
    assert radii.max() <= 0.5
    assert abs((radii < 0.25).float().mean() - 1 / 8) < 0.02  # volume goes with the cube
    torch.testing.assert_close(cloud.colors, torch.full((5000, 3), 0.5))
    torch.testing.assert_close(cloud.opacities, torch.full((5000,), 0.1))
    assert abs(float(cloud.scales.mean()) - 0.035) < 0.003  # the size that the public code gets for 5,000 points


def sphere(count: int) -> torch.Tensor:
    """Return points spread evenly over the unit sphere."""
    height = 1 - (2 * torch.arange(count) + 1) / count
    angle = math.pi * (1 + math.sqrt(5)) * torch.arange(count)
    around = (1 - height.square()).sqrt()
    return torch.stack((around * angle.cos(), around * angle.sin(), height), -1)


def test_gaussians_on_a_surface_are_flat_along_its_normals():
    points = sphere(100)
    cloud = on_surface(points, points, points.abs(), area=4.0, flatness=0.5)
    normals = quat_to_rotmat(cloud.quats)[..., 2]
    torch.testing.assert_close(normals, points, atol=1e-5, rtol=0)
    torch.testing.assert_close(cloud.scales[:, :2], torch.full((100, 2), 0.2))
    torch.testing.assert_close(cloud.scales[:, 2], torch.full((100,), 0.1))
    torch.testing.assert_close(cloud.colors, points.abs())
    torch.testing.assert_close(cloud.means, points)


def test_gaussians_on_a_sphere_hide_its_inside_and_keep_its_outline():
    points = 0.5 * sphere(2000)
    cloud = on_surface(points, 2 * points, torch.zeros(2000, 3), area=math.pi, flatness=0.5)
    camera = OrbitCamera(width=128, height=128)
    alpha = get_rasterizer("auto")(cloud, [camera], torch.ones(3)).alpha[0, ..., 0]
    places = torch.arange(128) + 0.5 - 64
    reach = (places[:, None].square() + places[None].square()).sqrt() / camera.focal
    outline = 0.5 / math.sqrt(camera.radius**2 - 0.25)  # tangent of the angle between axis and outline
    assert alpha[reach < 0.95 * outline].min() > 0.98
    assert alpha[reach > 1.2 * outline].max() < 0.05


def test_coincident_points_still_have_a_size():
    cloud = on_surface(torch.zeros(5, 3), torch.tensor([0.0, 0.0, -1.0]).expand(5, 3), torch.zeros(5, 3), area=0.0)
    assert torch.isfinite(cloud.log_scales).all()
    assert torch.isfinite(cloud.quats).all()
