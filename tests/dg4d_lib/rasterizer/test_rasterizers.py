"""Contract of all rasterizers: closed forms, and the reference in float64."""

import re
from dataclasses import replace
from math import exp, log, radians, sqrt, tan

import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.rasterizer import reference
from dg4d_lib.rasterizer.interface import BLUR, MIN_ALPHA

BACKGROUND = torch.tensor([0.2, 0.4, 0.6])
FRONT = OrbitCamera(width=33, height=33)  # odd: the origin is the center of pixel (16, 16)

SQUARE = OrbitCamera(10, 30, width=64, height=64)
SCENES = {
    "plain": ({}, SQUARE),
    "odd size": ({}, OrbitCamera(-20, 100, width=75, height=51)),
    "wide": ({"scale": 0.3}, OrbitCamera(0, 0, width=150, height=30)),
    "one tile": ({"scale": 0.2}, OrbitCamera(5, 5, width=16, height=16)),
    "needles": ({"scale": 0.02, "spread": 1.5}, OrbitCamera(10, 200, width=64, height=64)),
    "saturated": ({"opacity": 9.0, "scale": 0.1}, SQUARE),
    "faint": ({"opacity": -4.0, "scale": 0.1}, SQUARE),
    "dust": ({"scale": 0.001}, SQUARE),
    "huge": ({"scale": 2.0, "opacity": -2.0}, SQUARE),
    "off axis": ({"place": 1.0, "scale": 0.2}, replace(SQUARE, radius=1.2)),
    "around the camera": ({"place": 2.0, "scale": 0.3}, SQUARE),
    "own states": ({"states": 3}, SQUARE),
    "several cameras": ({"cameras": 3}, SQUARE),
}
ILL_CONDITIONED = ("needles", "saturated")
DARK = ("wide", "one tile", "huge")  # little light is left behind everything
# what rounding may cost: mean error of color, error of a pixel, relative error of gradients; and where digits are lost.
# Plain torch subtracts products of long axes and loses 1 - opacity near one; gsplat forms covariances in 3D, takes the
# fast exponential, and the last transmittance as 1 - alpha: measured on its kernels (benchmarks/RESULTS.md).
ROUNDING = {
    "reference": ((2e-7, 1e-5, 5e-6), (1e-6, 2e-3, 1e-3)),
    "cpu": ((2e-7, 1e-5, 5e-6), (2e-7, 1e-5, 2e-5)),
    "cuda_gsplat": ((5e-7, 3e-5, 1e-4), (2e-6, 1e-3, 2e-3)),
}
MOST_FLIPS = 1e-3  # share of pixels with a larger error: there a threshold falls the other way
WORST_FLIP = 0.02  # a least alpha, in units of color and depth


@pytest.mark.parametrize("scene", SCENES)
def test_pictures_and_gradients_are_those_of_the_definition(scene, backend, rasterize, random_cloud, drawn, gradients):
    shape, camera = SCENES[scene]
    views = shape.get("cameras", shape.get("states", 1))
    cameras = [replace(camera, azimuth_deg=camera.azimuth_deg + 120 * i) for i in range(views)]
    cloud = random_cloud(150, **{name: value for name, value in shape.items() if name != "cameras"})
    found, leaves = drawn(rasterize, cloud, cameras, torch.float32)
    truth, true_leaves = drawn(reference.rasterize, cloud, cameras, torch.float64)
    mean_error, pixel_error, gradient_error = ROUNDING[backend][
        scene in ILL_CONDITIONED or (backend == "cuda_gsplat" and scene in DARK)
    ]

    errors = [(getattr(found, name) - getattr(truth, name)).abs() for name in ("color", "alpha", "depth")]
    flipped = torch.cat(errors, -1).amax(-1, keepdim=True) > pixel_error
    assert flipped.float().mean() <= MOST_FLIPS
    assert max(error.max() for error in errors) < WORST_FLIP
    assert errors[0][~flipped[..., 0]].mean() <= mean_error
    assert not (truth.visible & ~found.visible).any()
    if backend != "cuda_gsplat":  # it rounds boxes up to whole pixels
        assert found.visible.equal(truth.visible)

    expected = gradients(truth, true_leaves, ~flipped)
    for name, gradient in gradients(found, leaves, ~flipped).items():
        error = (gradient - expected[name]).norm() / expected[name].norm()
        assert error < gradient_error, f"{name}: relative error {error:.1e}"


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


def test_colors_are_clamped_per_gaussian_which_the_public_code_does_below_only(rasterize, blobs):
    """Below one both formulas agree. Above, the public code mixes the whole color and clamps the picture."""
    background = torch.tensor([0.2, 0.0, 1.0]).double()
    for given, public, ours in (
        ((0.7, 0.3, 0.9), (0.7, 0.3, 0.9), (0.7, 0.3, 0.9)),
        ((1.5, -0.4, 1.1), (1.5, 0.0, 1.1), (1.0, 0.0, 1.0)),
    ):
        cloud = blobs([(0, 0, 0)], scale=0.2, opacity=0.6, colors=[given])
        picture = rasterize(cloud, [OrbitCamera(width=33, height=33)], background)
        alpha = picture.alpha[0, 16, 16]
        mixed = [alpha * torch.tensor(color).double() + (1 - alpha) * background for color in (public, ours)]
        torch.testing.assert_close(picture.color[0, 16, 16], mixed[1], rtol=1e-5, atol=1e-5)
        assert (picture.color[0, 16, 16] <= mixed[0].clamp(0, 1) + 1e-5).all()


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


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        ({"means": (1, torch.nan)}, "4 Gaussians have non-finite numbers (3 in means)"),
        ({"log_scales": (2, torch.inf)}, "(3 in log_scales)"),
        ({"quats": (0, torch.nan), "opacity_logits": (3, -torch.inf)}, "(4 in quats, 1 in opacity_logits)"),
        ({"harmonics": (0, torch.nan)}, "(3 in harmonics)"),
    ],
)
def test_what_is_not_finite_is_refused_by_name(broken, message, rasterize, blobs):
    cloud = blobs([(0, 0, 0)] * 4)
    for name, (row, value) in broken.items():
        getattr(cloud, name)[row] = value
    with pytest.raises(BadInput, match=re.escape(message)):
        rasterize(cloud, [FRONT], BACKGROUND)


def test_values_of_any_size_are_finite(rasterize, blobs):
    """Their sum is not, which is what is looked at first."""
    far = replace(blobs([(0, 0, 0)] * 4), means=torch.full((4, 3), 3e38))
    assert not rasterize(far.to(torch.float32), [FRONT], BACKGROUND).visible.any()


def test_nothing_seen_gives_zero_gradients(rasterize, blobs, drawn, gradients):
    picture, leaves = drawn(rasterize, blobs([(0, 0, 5), (9, 0, 0)]), [FRONT], torch.float32)
    assert all(gradient.eq(0).all() for gradient in gradients(picture, leaves).values())


@pytest.mark.parametrize("backend", ["reference", "cpu"])  # with gsplat, exp has no gradient where it overflows
@pytest.mark.parametrize(("height", "log_scale"), [(2.0, -3.0), (0.0, 400.0)])
def test_what_cannot_be_projected_has_no_gradients(height, log_scale, rasterize, blobs, drawn, gradients):
    """A mean in the plane of the camera divides by zero, and a huge scale overflows."""
    cloud = blobs([(0.0, 0.0, 0.0), (0.0, 0.0, height)])
    cloud.log_scales[1] = log_scale
    rendering, leaves = drawn(rasterize, cloud, [FRONT], torch.float32)
    assert rendering.visible.tolist() == [[True, False]]
    found = gradients(rendering, leaves)
    assert found.pop("means2d_offsets")[0, 1].eq(0).all()
    assert all(gradient[0].isfinite().all() and gradient[1].eq(0).all() for gradient in found.values())
    assert found["means"][0].any()


def test_white_behind_everything_is_white(rasterize, blobs):
    white = rasterize(blobs([(0, 0, 0)], colors=[(1, 1, 1)]), [FRONT], torch.ones(3))
    torch.testing.assert_close(white.color, torch.ones_like(white.color), atol=2e-7, rtol=0)


def test_the_norm_of_a_quaternion_does_not_matter(rasterize, random_cloud):
    cloud = random_cloud(40)
    longer = replace(cloud, quats=4 * cloud.quats)
    assert rasterize(cloud, [FRONT], BACKGROUND).color.equal(rasterize(longer, [FRONT], BACKGROUND).color)


def test_pictures_and_gradients_come_back_in_the_precision_of_the_cloud(rasterize, random_cloud, drawn, gradients):
    for dtype in (torch.float32, torch.float64):
        picture, leaves = drawn(rasterize, random_cloud(20), [FRONT], dtype)
        assert {value.dtype for value in (picture.color, picture.alpha, picture.depth)} == {dtype}
        assert {value.dtype for value in gradients(picture, leaves).values()} == {dtype}


def test_without_gradients_or_offsets_the_picture_is_the_same(rasterize, random_cloud, drawn):
    cloud = random_cloud(40).to(torch.float32)
    picture, _ = drawn(rasterize, cloud, [FRONT], torch.float32, BACKGROUND)
    with torch.no_grad():
        assert rasterize(cloud, [FRONT], BACKGROUND).color.equal(picture.color)
        assert rasterize(cloud, [FRONT], BACKGROUND, torch.zeros(1, 40, 2)).color.equal(picture.color)


def test_the_screen_gradient_is_what_a_shift_of_the_picture_gives(rasterize, blobs, drawn, gradients):
    """A blob far from thresholds: per pixel along x, the sum of alpha times x grows by the sum of alpha."""
    picture, leaves = drawn(rasterize, blobs([(0, 0, 0)], scale=0.05, opacity=0.8), [FRONT], torch.float32)
    columns = torch.arange(33) + 0.5
    (gradient,) = torch.autograd.grad((picture.alpha[..., 0] * columns).sum(), leaves["means2d_offsets"])
    # alpha below 1/255 is cut off, a share of 1/255 / 0.8 of all of it
    torch.testing.assert_close(gradient[0, 0], torch.stack((picture.alpha.sum(), torch.zeros(()))), atol=0.2, rtol=0.05)


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


@pytest.mark.parametrize("count", [1, 7, 31])
def test_few_gaussians_keep_the_gradients_of_every_state_apart(count, rasterize, random_cloud, forward_and_backward):
    cameras = [replace(SQUARE, azimuth_deg=120.0 * i) for i in range(3)]
    cloud = random_cloud(count, states=3, scale=0.1)
    _, expected = forward_and_backward(reference.rasterize, cloud, cameras, torch.float64)
    _, found = forward_and_backward(rasterize, cloud, cameras, torch.float32)
    for name, gradient in found.items():
        assert (gradient - expected[name]).norm() < 1e-3 * expected[name].norm(), name


def test_a_wrong_number_of_states_or_cameras_of_two_sizes_are_refused(rasterize, random_cloud):
    with pytest.raises(BadInput, match="2 states"):
        rasterize(random_cloud(3, states=3), [FRONT, FRONT], BACKGROUND)
    with pytest.raises(BadInput, match="the same size"):
        rasterize(random_cloud(3), [FRONT, OrbitCamera(width=16, height=16)], BACKGROUND)
    with pytest.raises(BadInput, match="no camera"):
        rasterize(random_cloud(3), [], BACKGROUND)
