import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.guidance.geometric import InflatedSurfaces, averaged_over_depth
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.inflation.hints import DepthHint
from dg4d_lib.settings import GeometricPriorSettings

SIZE = 48


def disc(x: float) -> torch.Tensor:
    rows, columns = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    alpha = ((columns - x) ** 2 + (rows - 24) ** 2 < 100).float()[..., None]
    return torch.cat([torch.tensor([0.9, 0.3, 0.1]).expand(SIZE, SIZE, 3), alpha], -1)


SETTINGS = GeometricPriorSettings(size=SIZE)
CAMERA = OrbitCamera(width=SIZE, height=SIZE)


def test_the_input_view_of_a_frame_shows_that_frame_over_white():
    surfaces = InflatedSurfaces([disc(16), disc(32)], SETTINGS)
    color, coverage = surfaces.clean([GuidanceView(CAMERA, 1), GuidanceView(CAMERA, 0)])
    for view, x in enumerate((32, 16)):
        picture = disc(x)
        share = (coverage[view] - picture[..., 3:]).abs().mean()
        assert share < 0.02
        inside = (picture[..., 3] == 1) & (coverage[view, ..., 0] == 1)
        torch.testing.assert_close(color[view][inside], picture[inside][:, :3])
        assert (color[view][coverage[view, ..., 0] == 0] == 1).all()


def test_views_do_not_depend_on_their_neighbors():
    views = [
        GuidanceView(OrbitCamera(elevation, 70 * elevation, width=32, height=32), elevation % 2)
        for elevation in range(5)
    ]
    surfaces = InflatedSurfaces([disc(16), disc(32)], SETTINGS)
    color, coverage = surfaces.clean(views)
    for i, view in enumerate(views):
        alone, cover = InflatedSurfaces([disc(16), disc(32)], SETTINGS).clean([view])
        assert torch.equal(alone[0], color[i]) and torch.equal(cover[0], coverage[i])


def test_only_the_frames_that_are_asked_for_are_built_and_only_once():
    surfaces = InflatedSurfaces([disc(16), torch.zeros(SIZE, SIZE, 4)], SETTINGS)
    assert surfaces.surface(0) is surfaces.surface(0)
    with pytest.raises(BadInput, match="no subject"):
        surfaces.surface(1)


def test_the_turn_of_the_subject_is_used():
    color, _ = InflatedSurfaces([disc(24)], SETTINGS).clean([GuidanceView(OrbitCamera(0, 50, width=SIZE, height=SIZE))])
    turned, _ = InflatedSurfaces([disc(24)], SETTINGS, hint=DepthHint(40)).clean(
        [GuidanceView(OrbitCamera(0, 50, width=SIZE, height=SIZE))]
    )
    assert (color - turned).abs().mean() > 0.01


@pytest.mark.parametrize("frame", [-1, 1])
def test_a_frame_that_is_not_there_is_refused(frame):
    with pytest.raises(BadInput, match="there are 1"):
        InflatedSurfaces([disc(24)], SETTINGS).clean([GuidanceView(CAMERA, frame)])


def test_no_view_at_all_is_refused():
    with pytest.raises(BadInput, match="at least one"):
        InflatedSurfaces([disc(24)], SETTINGS).clean([])


def test_large_pictures_show_the_same_surface():
    surfaces = InflatedSurfaces([disc(20)], SETTINGS)
    small, large = (surfaces.clean([GuidanceView(OrbitCamera(10, 40, width=s, height=s))])[1] for s in (SIZE, 3 * SIZE))
    shrunk = torch.nn.functional.avg_pool2d(large.permute(0, 3, 1, 2), 3).permute(0, 2, 3, 1)
    torch.testing.assert_close(shrunk, small, atol=0.4, rtol=0)
    assert (shrunk - small).abs().mean() < 0.01


def spread(image: torch.Tensor, axis: int) -> float:
    weights = image.sum(1 - axis)
    places = torch.arange(len(weights), dtype=weights.dtype)
    mean = (weights * places).sum() / weights.sum()
    return float((weights * (places - mean) ** 2).sum() / weights.sum()) ** 0.5


@pytest.mark.parametrize(
    ("elevation", "azimuth", "down", "across"), [(0, 0, 0, 0), (0, 90, 0, 1), (90, 0, 1, 0), (0, 30, 0, 0.5)]
)
def test_depth_blurs_along_the_direction_in_which_it_shows(elevation, azimuth, down, across):
    camera = OrbitCamera(elevation, azimuth, width=65, height=65)
    point = torch.zeros(1, 65, 65, 1)
    point[0, 32, 32] = 1
    blurred = averaged_over_depth(point, [camera], 0.1)[0, ..., 0]
    sigma = 0.1 * camera.focal / camera.radius
    assert spread(blurred, 0) == pytest.approx(down * sigma, abs=0.02)
    assert spread(blurred, 1) == pytest.approx(across * sigma, abs=0.02)
    assert blurred.sum() == pytest.approx(1, abs=1e-4)


def test_the_blur_is_the_normalized_gaussian_of_the_places_inside():
    cameras = [
        OrbitCamera(elevation, azimuth, width=30, height=30) for elevation, azimuth in ((0, 0), (20, 90), (80, 40))
    ]
    images = torch.rand(3, 30, 30, 2, generator=torch.Generator().manual_seed(0))
    places = torch.arange(30.0, dtype=torch.float64)
    for camera, image, found in zip(cameras, images, averaged_over_depth(images, cameras, 0.15), strict=True):
        depth = camera.viewmat()[:2, 2].abs() * 0.15 * camera.focal / camera.radius
        weights = [(-((places[:, None] - places) ** 2) / (2 * max(float(d), 1e-3) ** 2)).exp() for d in depth]
        across, down = (each / each.sum(1, keepdim=True) for each in weights)
        expected = torch.einsum("ij,jlc,kl->ikc", down, image.double(), across)
        torch.testing.assert_close(found.double(), expected, rtol=0, atol=3e-6)  # tails beyond five sigma
