from dataclasses import replace

import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.inflation.render import render_surface
from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.mesh_rasterizer.zbuffer import interpolate, rasterize_mesh


def tent(seed: int = 0) -> InflatedSurface:
    vertices = torch.tensor([[-0.5, -0.4, 0.0], [0.5, -0.4, 0.1], [0.0, 0.5, 0.0], [0.1, 0.0, 0.4]])
    faces = torch.tensor([[0, 1, 3], [1, 2, 3], [2, 0, 3]])
    return InflatedSurface(
        vertices, faces, torch.rand(4, 3, generator=torch.Generator().manual_seed(seed)), torch.ones(4) > 0
    )


@pytest.mark.parametrize("supersample", [1, 2, 3])
def test_a_pixel_is_the_mean_of_its_samples(supersample):
    camera = OrbitCamera(15, 40, width=20, height=16)
    fine = replace(camera, width=20 * supersample, height=16 * supersample)
    surface = tent()
    fragments = rasterize_mesh(surface.vertices, surface.faces, [fine])
    samples = torch.cat(
        [interpolate(fragments, surface.faces, surface.colors), (fragments.faces >= 0).float()[..., None]], -1
    )
    means = torch.nn.functional.avg_pool2d(samples.permute(0, 3, 1, 2), supersample).permute(0, 2, 3, 1)
    color, coverage = render_surface(surface, [camera], supersample)
    torch.testing.assert_close(coverage, means[..., 3:])
    torch.testing.assert_close(color * coverage, means[..., :3], atol=1e-6, rtol=1e-5)


def test_each_camera_may_have_its_own_surface():
    cameras = [OrbitCamera(0, azimuth, width=16, height=16) for azimuth in (0, 60)]
    color, coverage = render_surface([tent(0), tent(1)], cameras)
    for i in range(2):
        alone, cover = render_surface(tent(i), [cameras[i]])
        assert torch.equal(color[i], alone[0]) and torch.equal(coverage[i], cover[0])


def test_another_number_of_surfaces_than_cameras_is_refused():
    with pytest.raises(BadInput, match="3 surfaces and 2 cameras"):
        render_surface([tent()] * 3, [OrbitCamera(width=8, height=8)] * 2)


def test_cameras_of_different_sizes_are_refused():
    with pytest.raises(BadInput, match="one size"):
        render_surface(tent(), [OrbitCamera(width=8, height=8), OrbitCamera(width=16, height=16)])
