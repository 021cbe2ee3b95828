import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.guidance.geometric import InflatedSurfaces
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.guidance.mixed import MixedShapes
from dg4d_lib.settings import GeometricPriorSettings

VIEWS = [GuidanceView(OrbitCamera(0, azimuth, width=32, height=32)) for azimuth in (0, 75)]


def shapes(width: int) -> InflatedSurfaces:
    """Return the inflation of a red rectangle, 20 pixels high."""
    cutout: Float[Tensor, "h w 4"] = torch.zeros(32, 32, 4)
    cutout[6:26, 16 - width // 2 : 16 + width // 2] = torch.tensor([0.8, 0.1, 0.1, 1.0])
    return InflatedSurfaces([cutout], GeometricPriorSettings(size=32))


def test_views_are_the_expected_ones_and_the_surface_is_that_of_the_first() -> None:
    narrow, wide = shapes(8), shapes(16)
    mixed = MixedShapes(narrow, wide, 0.25)
    for both, one, other in zip(mixed.clean(VIEWS), narrow.clean(VIEWS), wide.clean(VIEWS), strict=True):
        torch.testing.assert_close(both, 0.75 * one + 0.25 * other)
        assert not torch.allclose(one, other)
    assert torch.equal(mixed.surface(0).vertices, narrow.surface(0).vertices)
