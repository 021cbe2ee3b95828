"""Closed forms: what the definition must give where the answer is known."""

from dataclasses import replace
from math import exp, log, radians, sqrt, tan

import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.rasterizer.interface import BLUR, MIN_ALPHA, choose_rasterizer, shared_size

BACKGROUND = torch.tensor([0.2, 0.4, 0.6])
FRONT = OrbitCamera(width=33, height=33)  # odd: the origin is the center of pixel (16, 16)


@pytest.fixture(params=["reference", "cpu"])
def rasterize(request):
    return choose_rasterizer(request.param)


def test_alpha_at_the_center_of_a_blob_is_its_opacity(rasterize, blobs):
    for opacity in (0.05, 0.5, 0.9):
        picture = rasterize(blobs([(0, 0, 0)], opacity=opacity), [FRONT], BACKGROUND)
        assert picture.alpha[0, 16, 16, 0].item() == pytest.approx(opacity, abs=1e-6)
        assert picture.depth[0, 16, 16, 0].item() == pytest.approx(opacity * FRONT.radius, abs=1e-6)


def test_a_round_blob_falls_off_as_its_projected_gaussian_does(rasterize, blobs):
    scale, camera = 0.1, OrbitCamera(width=65, height=65)
    picture = rasterize(blobs([(0, 0, 0)], scale=scale, opacity=0.7), [camera], BACKGROUND)
    variance = (scale * camera.focal / camera.radius) ** 2 + BLUR
    for distance in (1, 3, 5):
        assert picture.alpha[0, 32, 32 + distance, 0].item() == pytest.approx(
            0.7 * exp(-(distance**2) / (2 * variance)), abs=2e-6
        )


def test_nothing_is_drawn_below_the_least_alpha(rasterize, blobs):
    scale, camera = 0.1, OrbitCamera(width=65, height=65)
    alpha = rasterize(blobs([(0, 0, 0)], scale=scale, opacity=0.7), [camera], BACKGROUND).alpha[0, 32, 32:, 0]
    variance = (scale * camera.focal / camera.radius) ** 2 + BLUR
    reach = sqrt(2 * variance * log(0.7 / MIN_ALPHA))
    covered = int((alpha > 0).sum())
    assert covered - 1 <= reach < covered
    assert alpha[covered - 1] >= MIN_ALPHA


def test_two_on_a_ray_cover_as_two_glasses_do(rasterize, blobs):
    red_before_blue = blobs([(0, 0, 0.2), (0, 0, -0.2)], opacity=0.6, colors=[(1, 0, 0), (0, 0, 1)])
    picture = rasterize(red_before_blue, [FRONT], BACKGROUND)
    expected = torch.tensor([0.6 + 0.16 * 0.2, 0.16 * 0.4, 0.4 * 0.6 + 0.16 * 0.6]).double()
    torch.testing.assert_close(picture.color[0, 16, 16], expected, atol=1e-6, rtol=0)
    assert picture.alpha[0, 16, 16, 0].item() == pytest.approx(0.84, abs=1e-6)
    assert picture.depth[0, 16, 16, 0].item() == pytest.approx(0.6 * 1.8 + 0.24 * 2.2, abs=1e-6)


def test_from_behind_the_order_is_reversed(rasterize, blobs):
    cloud = blobs([(0, 0, 0.2), (0, 0, -0.2)], opacity=0.9, colors=[(1, 0, 0), (0, 0, 1)])
    front, back = rasterize(cloud, [FRONT, replace(FRONT, azimuth_deg=180.0)], BACKGROUND).color[:, 16, 16]
    assert front[0] > 0.9 > front[2]
    assert back[2] > 0.9 > back[0]


def test_up_in_the_world_is_up_in_the_picture_and_right_is_right(rasterize, blobs):
    up, right = (
        rasterize(blobs([place]), [FRONT], BACKGROUND).alpha[0, ..., 0] for place in ((0, 0.4, 0), (0.4, 0, 0))
    )
    assert up[:16].sum() > 0 == up[17:].sum()
    assert right[:, 17:].sum() > 0 == right[:, :16].sum()


def test_a_blob_lands_where_a_pinhole_puts_it(rasterize, blobs):
    camera = OrbitCamera(width=101, height=61)
    alpha = rasterize(blobs([(0.5, 0.2, 0.3)], scale=0.02), [camera], BACKGROUND).alpha[0, ..., 0]
    rows, columns = torch.meshgrid(torch.arange(61) + 0.5, torch.arange(101) + 0.5, indexing="ij")
    focal = 30.5 / tan(radians(camera.fov_y_deg) / 2)
    depth = camera.radius - 0.3
    assert ((alpha * columns).sum() / alpha.sum()).item() == pytest.approx(50.5 + focal * 0.5 / depth, abs=0.02)
    assert ((alpha * rows).sum() / alpha.sum()).item() == pytest.approx(30.5 - focal * 0.2 / depth, abs=0.02)


def test_order_of_the_gaussians_does_not_matter(rasterize, random_cloud):
    cloud = random_cloud(60)
    turned = Gaussians(**{name: value.flip(0) for name, value in vars(cloud).items()})
    first, second = (rasterize(gaussians, [FRONT], BACKGROUND) for gaussians in (cloud, turned))
    torch.testing.assert_close(first.color, second.color, atol=1e-7, rtol=0)
    assert first.visible.flip(1).equal(second.visible)


def test_a_pixel_stops_before_its_limit_and_never_resumes(rasterize, blobs):
    """0.08^3 is above 1e-4, 0.08^4 is not; the faint one behind would fit again, and is not drawn either."""
    cloud = blobs([(0, 0, 0.1 * i) for i in range(5)], opacity=0.92, scale=0.3)
    cloud.opacity_logits[0] = torch.tensor(0.1).double().logit()  # the one at z = 0 is the farthest
    alpha = rasterize(cloud, [FRONT], BACKGROUND).alpha[0, 16, 16, 0].item()
    assert alpha == pytest.approx(1 - 0.08**3, abs=1e-6)


def test_alpha_of_one_blob_stops_at_its_greatest_value(rasterize, blobs):
    cloud = blobs([(0, 0, 0)])
    solid = replace(cloud, opacity_logits=torch.full((1,), 30.0).double())
    assert rasterize(solid, [FRONT], BACKGROUND).alpha.max().item() == pytest.approx(0.999, abs=1e-6)


def test_behind_or_close_to_the_camera_nothing_is_drawn(rasterize, blobs):
    for place in ((0, 0, 1.9), (0, 0, 3.0)):
        picture = rasterize(blobs([place]), [FRONT], BACKGROUND)
        assert not picture.visible.any()
        torch.testing.assert_close(picture.color[0], BACKGROUND.expand(33, 33, 3).double(), atol=1e-7, rtol=0)
        assert picture.alpha.max() == picture.depth.max() == 0


def test_what_is_off_the_screen_is_not_visible(rasterize, blobs):
    picture = rasterize(blobs([(0, 0, 0), (4, 0, 0), (0, -4, 0)]), [FRONT, FRONT], BACKGROUND)
    assert picture.visible.tolist() == [[True, False, False]] * 2


def test_an_empty_cloud_shows_the_background(rasterize, random_cloud):
    picture = rasterize(random_cloud(0), [FRONT, FRONT], BACKGROUND)
    torch.testing.assert_close(picture.color, BACKGROUND.expand(2, 33, 33, 3).double(), atol=1e-7, rtol=0)
    assert picture.visible.shape == (2, 0)


def test_what_is_not_finite_is_not_drawn(rasterize, blobs):
    cloud = blobs([(0, 0, 0)] * 4)
    cloud.means[1, 0], cloud.log_scales[2, 1], cloud.quats[3] = torch.nan, 800.0, 0.0
    picture = rasterize(cloud, [FRONT], BACKGROUND)
    assert picture.visible[0, :3].tolist() == [True, False, False]
    assert picture.color.isfinite().all()


def test_several_cameras_give_what_each_gives_alone(rasterize, random_cloud):
    cloud = random_cloud(40)
    cameras = [OrbitCamera(azimuth_deg=40.0 * i, width=48, height=40) for i in range(3)]
    together = rasterize(cloud, cameras, BACKGROUND)
    for i, camera in enumerate(cameras):
        alone = rasterize(cloud, [camera], BACKGROUND)
        assert together.color[i].equal(alone.color[0])
        assert together.visible[i].equal(alone.visible[0])


def test_states_of_their_own_are_drawn_one_per_camera(rasterize, random_cloud):
    moving = random_cloud(40, states=2)
    cameras = [FRONT, replace(FRONT, azimuth_deg=70.0)]
    together = rasterize(moving, cameras, BACKGROUND)
    for i, camera in enumerate(cameras):
        assert together.color[i].equal(rasterize(moving.at(i), [camera], BACKGROUND).color[0])


def test_a_wrong_number_of_states_or_sizes_is_refused(rasterize, random_cloud):
    with pytest.raises(BadInput, match="2 states"):
        rasterize(random_cloud(3, states=3), [FRONT, FRONT], BACKGROUND)
    with pytest.raises(BadInput, match="one size"):
        rasterize(random_cloud(3), [FRONT, OrbitCamera(width=16, height=16)], BACKGROUND)
    with pytest.raises(BadInput, match="no camera"):
        shared_size([])


def test_an_unknown_rasterizer_is_refused():
    with pytest.raises(BadInput, match="auto, reference, cpu"):
        choose_rasterizer("magic")


def test_gradients_of_the_definition_are_its_differences(random_cloud):
    """Few soft Gaussians on 5 x 5 pixels, so that no threshold lies within a step of the differences."""
    rasterize = choose_rasterizer("reference")
    cloud = random_cloud(3, scale=0.4, spread=0.1, place=0.1)
    cameras = [OrbitCamera(azimuth_deg=20.0, width=5, height=5)]

    def pictures(*leaves):
        rendering = rasterize(Gaussians(*leaves[:5]), cameras, BACKGROUND.double(), leaves[5])
        return rendering.color, rendering.alpha, rendering.depth

    leaves = [*vars(cloud).values(), torch.zeros(1, 3, 2).double()]
    assert torch.autograd.gradcheck(pictures, [leaf.requires_grad_() for leaf in leaves], fast_mode=True)
