"""Gradients of the reference rasterizer against finite differences, in float64."""

import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.rasterizer.reference import rasterize

BACKGROUND = torch.tensor([0.2, 0.4, 0.6]).double()
PIXELS = {"width": 5, "height": 5}


def leaves_of(cloud: Gaussians, views: int) -> list[torch.Tensor]:
    leaves = [*vars(cloud).values(), torch.zeros(views, len(cloud), 2).double()]
    return [leaf.requires_grad_() for leaf in leaves]


@pytest.mark.parametrize("states", [0, 2])
def test_gradients_are_differences(states, random_cloud):
    """Few soft Gaussians on 5 x 5 pixels, so that no threshold lies within a step of the differences."""
    cloud = random_cloud(3, states, scale=0.4, spread=0.1, place=0.1)
    cameras = [OrbitCamera(azimuth_deg=20.0 + 90 * i, **PIXELS) for i in range(2)]

    def pictures(*leaves):
        rendering = rasterize(Gaussians(*leaves[:5]), cameras, BACKGROUND, leaves[5])
        return rendering.color, rendering.alpha, rendering.depth

    assert torch.autograd.gradcheck(pictures, leaves_of(cloud, 2), fast_mode=True)


def test_gradients_beyond_the_margin_of_the_frustum_are_differences(blobs):
    """There the Jacobian no longer depends on x, but still on z."""
    camera = OrbitCamera(**PIXELS)
    cloud = blobs([(1.6, 0.1, 0.2), (0.1, -1.5, 0.1)], scale=0.7)
    x, y, z = (cloud.means @ camera.viewmat()[:3, :3].T + camera.viewmat()[:3, 3]).unbind(-1)
    assert (torch.maximum(x.abs(), y.abs()) / z > 1.3 * camera.tan_half_fov[0]).all()

    def pictures(*leaves):
        rendering = rasterize(Gaussians(*leaves[:5]), [camera], BACKGROUND, leaves[5])
        assert rendering.visible.all()
        return rendering.color, rendering.alpha, rendering.depth

    assert torch.autograd.gradcheck(pictures, leaves_of(cloud, 1), fast_mode=True)
