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
    narrow, wide, wider = (shapes(width) for width in (8, 16, 22))
    mixed = MixedShapes([narrow, wide, wider], [0.5, 0.3, 0.2])
    each = (guess.clean(VIEWS) for guess in (mixed, narrow, wide, wider))
    for mean, one, other, third in zip(*each, strict=True):
        torch.testing.assert_close(mean, 0.5 * one + 0.3 * other + 0.2 * third)
        assert not torch.allclose(one, other) and not torch.allclose(other, third)
    assert torch.equal(mixed.surface(0).vertices, narrow.surface(0).vertices)
