import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.guidance.geometric import InflatedSurfaces
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.guidance.mixed import MixedShapes, outline_overlaps
from dg4d_lib.settings import GeometricPriorSettings

VIEWS = [GuidanceView(OrbitCamera(0, azimuth, width=32, height=32)) for azimuth in (0, 75)]


def rectangle(width: int) -> Float[Tensor, "h w 4"]:
    """Return a red rectangle, 20 pixels high."""
    cutout = torch.zeros(32, 32, 4)
    cutout[6:26, 16 - width // 2 : 16 + width // 2] = torch.tensor([0.8, 0.1, 0.1, 1.0])
    return cutout


def shapes(*widths: int) -> InflatedSurfaces:
    """Return the inflation of a rectangle per frame."""
    return InflatedSurfaces([rectangle(width) for width in widths], GeometricPriorSettings(size=32))


def test_views_are_the_expected_ones_and_the_surface_is_that_of_the_first() -> None:
    narrow, wide = shapes(8), shapes(16)
    mixed = MixedShapes(narrow, wide, [0.25])
    for both, one, other in zip(mixed.clean(VIEWS), narrow.clean(VIEWS), wide.clean(VIEWS), strict=True):
        torch.testing.assert_close(both, 0.75 * one + 0.25 * other)
        assert not torch.allclose(one, other)
    assert torch.equal(mixed.surface(0).vertices, narrow.surface(0).vertices)


def test_every_frame_has_its_own_share() -> None:
    views = [GuidanceView(VIEWS[1].camera, frame) for frame in (1, 0)]
    narrow, wide = shapes(8, 8), shapes(16, 16)
    color, alpha = MixedShapes(narrow, wide, [0.0, 1.0]).clean(views)
    for row, kind in enumerate((wide, narrow)):  # frame 1 first
        alone = kind.clean(views[row : row + 1])
        torch.testing.assert_close((color[row], alpha[row]), (alone[0][0], alone[1][0]))


def test_the_overlap_of_outlines_is_that_of_the_rectangles() -> None:
    exact, half = outline_overlaps(shapes(16, 8), [rectangle(16), rectangle(16)])
    assert exact > 0.9
    assert abs(half - 0.5) < 0.08
