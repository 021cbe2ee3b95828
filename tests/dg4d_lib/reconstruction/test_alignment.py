import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.initialize import isotropic
from dg4d_lib.rasterizer.interface import get_rasterizer
from dg4d_lib.reconstruction.alignment import best_azimuth

WHITE = torch.ones(3)


def lopsided() -> Gaussians:
    """A gray body with a red nose in front, a blue tail behind and a green ear on one side."""
    generator = torch.Generator().manual_seed(0)
    parts = (
        ((0.0, 0.0, 0.0), 0.35, (0.5, 0.5, 0.5)),
        ((0.0, 0.1, 0.45), 0.12, (0.9, 0.1, 0.1)),
        ((0.1, 0.0, -0.5), 0.15, (0.1, 0.2, 0.9)),
        ((0.4, 0.3, 0.0), 0.12, (0.1, 0.8, 0.2)),
    )
    means = torch.cat(
        [torch.tensor(center) + size * torch.randn(150, 3, generator=generator) / 2 for center, size, _ in parts]
    )
    colors = torch.cat([torch.tensor(color).expand(150, 3) for _, _, color in parts])
    return isotropic(means, torch.full((600,), 0.04), colors, 0.8)


@pytest.mark.parametrize("azimuth", [0.0, 33.3, -97.8, 179.6])
def test_the_known_rotation_is_found_within_a_degree(azimuth: float):
    cloud, rasterize = lopsided(), get_rasterizer("cpu")
    picture = rasterize(cloud, [OrbitCamera(0, azimuth, width=256, height=256)], WHITE).color[0]
    found = best_azimuth(cloud, picture, rasterize)
    assert -180 <= found < 180
    assert abs((found - azimuth + 180) % 360 - 180) < 1


def test_it_is_found_in_another_rendition_of_the_object():
    """What LGM makes is never quite the picture: other colors, noise, another size."""
    cloud, rasterize = lopsided(), get_rasterizer("cpu")
    picture = rasterize(cloud, [OrbitCamera(0, 61.0, radius=1.9, width=200, height=200)], WHITE).color[0]
    noise = 0.1 * torch.randn(picture.shape, generator=torch.Generator().manual_seed(1))
    assert best_azimuth(cloud, (0.9 * picture + 0.05 + noise).clamp(0, 1), rasterize) == pytest.approx(61.0, abs=1)
