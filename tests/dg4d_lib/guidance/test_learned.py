"""Expected views by the shape prior, behind the interface that the inflation has."""

from dataclasses import replace

import pytest
import torch
from tiny_shape_prior import tiny_network

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.guidance.interface import GuidanceView, SubjectShapes
from dg4d_lib.guidance.learned import LearnedShapes
from dg4d_lib.settings import LearnedPriorSettings
from dg4d_lib.shape_prior.field import ShapeField, ShapeFields

SIZE = 48
SETTINGS = LearnedPriorSettings(depth_sigma=0)
AVERAGES = LearnedPriorSettings(contrast=2)


def disc(x: float) -> torch.Tensor:
    rows, columns = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    alpha = ((columns - x) ** 2 + (rows - 24) ** 2 < 100).float()[..., None]
    return torch.cat([torch.tensor([0.9, 0.3, 0.1]).expand(SIZE, SIZE, 3), alpha], -1)


def shapes(*places: float, settings: LearnedPriorSettings = SETTINGS) -> SubjectShapes:
    return LearnedShapes(ShapeFields(tiny_network(), [disc(x) for x in places]), settings)


@pytest.mark.parametrize("settings", [SETTINGS, AVERAGES])
def test_the_input_view_of_a_frame_shows_that_frame_over_white(settings):
    color, alpha = shapes(16, 32, settings=settings).clean(
        [GuidanceView(OrbitCamera(width=SIZE, height=SIZE), frame) for frame in (1, 0)]
    )
    for view, x in enumerate((32, 16)):
        picture = disc(x)
        assert (alpha[view] - picture[..., 3:]).abs().mean() < 0.06  # a tenth of the disc shines through, and edges
        outside = torch.nn.functional.max_pool2d(picture[None, ..., 3], 9, 1, 4)[0] == 0
        assert (color[view][outside] - 1).abs().max() < 0.01


@pytest.mark.parametrize("settings", [SETTINGS, AVERAGES])
def test_views_do_not_depend_on_their_neighbors(settings):
    views = [GuidanceView(OrbitCamera(10 * i, 70 * i, width=32, height=32), i % 2) for i in range(4)]
    color, alpha = shapes(16, 32, settings=settings).clean(views)
    for i, view in enumerate(views):
        alone, cover = shapes(16, 32, settings=settings).clean([view])
        assert torch.equal(alone[0], color[i]) and torch.equal(cover[0], alpha[i])


@pytest.mark.parametrize(
    ("settings", "sizes"), [(SETTINGS, ((33, 33), (128, 128), (512, 512), (64, 40))), (AVERAGES, ((64, 40),))]
)
def test_pictures_have_the_size_of_their_camera(settings, sizes):
    for height, width in sizes:
        color, alpha = shapes(24, settings=settings).clean(
            [GuidanceView(OrbitCamera(0, 30, width=width, height=height))]
        )
        assert color.shape == (1, height, width, 3) and alpha.shape == (1, height, width, 1)
        assert ((color >= 0) & (color <= 1)).all() and ((alpha >= 0) & (alpha <= 1)).all()


def test_unsure_depth_blurs_the_side_and_not_the_front():
    front, side = (GuidanceView(OrbitCamera(0, azimuth, width=SIZE, height=SIZE)) for azimuth in (0, 90))
    soft = shapes(24, settings=LearnedPriorSettings(depth_sigma=0.1))
    for view, changed in ((front, False), (side, True)):
        difference = (soft.clean([view])[1] - shapes(24).clean([view])[1]).abs().max()
        assert bool(difference > 0.05) == changed


def test_the_surface_of_a_frame_lies_where_the_frame_shows_it():
    surface = shapes(16, 32).surface(1)
    assert surface.vertices[:, 0].mean() > 0.1 and surface.colors.max() <= 1


class PartlyInflated(ShapeFields):
    """Fields that take a certain share from the inflation in every frame."""

    def predict(self, frame: int) -> ShapeField:
        return replace(super().predict(frame), inflated_share=(0.2, 0.9, 0.6)[frame])


def test_the_share_of_the_inflation_is_the_mean_over_the_frames_asked_for():
    found = LearnedShapes(PartlyInflated(tiny_network(), [disc(x) for x in (16, 24, 32)]), SETTINGS)
    assert found.inflated_share == 0
    for frame in (0, 2, 0):
        found.surface(frame)
    assert found.inflated_share == pytest.approx(0.4)


@pytest.mark.parametrize("frame", [-1, 1])
def test_a_frame_that_is_not_there_is_refused(frame):
    with pytest.raises(BadInput, match="there are 1"):
        shapes(24).clean([GuidanceView(OrbitCamera(width=32, height=32), frame)])


def test_no_view_and_views_of_two_sizes_are_refused():
    with pytest.raises(BadInput, match="at least one"):
        shapes(24).clean([])
    with pytest.raises(BadInput, match="one size"):
        shapes(24).clean([GuidanceView(OrbitCamera()), GuidanceView(OrbitCamera(width=64, height=64))])
