from dataclasses import replace

import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.deformation.factory import new_deformation
from dg4d_lib.deformation.framewise import Framewise
from dg4d_lib.deformation.hexplane import HexPlane
from dg4d_lib.deformation.mlp import Mlp
from dg4d_lib.errors import FitDiverged
from dg4d_lib.fitting.motion import bounds_of, fit_motion, parameter_groups, sample_frames, sample_views
from dg4d_lib.settings import HexPlaneSettings, MlpSettings, ResolutionStage
from dg4d_lib.video.driving import DrivingVideo
from dg4d_lib.visual_hull.known import KnownView

SIZE, FRAMES, SLIDE = 32, 4, 0.3


def seed(number: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(number)


def make(kind: str, known):
    box = bounds_of(known.gaussians)
    match kind:
        case "hexplane":
            return HexPlane(HexPlaneSettings(spatial=4, temporal=4, features=8, hidden=16), box, seed())
        case "mlp":
            return Mlp(MlpSettings(frequencies=2, hidden=16), box, seed())
        case _:
            return Framewise(FRAMES, len(known.gaussians))


@pytest.mark.parametrize(
    "kind", ["hexplane", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("mlp", "framewise"))]
)
def test_a_slide_along_x_is_recovered(kind: str, known, motion_settings):
    deformation = make(kind, known)
    video = known.video()
    fit_motion(known.gaussians, deformation, video, known.prior(0.5), known.rasterize, motion_settings, seed())
    slid = deformation.displace(known.gaussians.means, video.times).means.median(1).values
    expected = torch.stack([SLIDE * video.times, torch.zeros(FRAMES), torch.zeros(FRAMES)], -1)
    assert (slid - expected).abs().max() < 0.03


def test_a_known_view_of_a_later_frame_shows_motion_along_the_axis_of_the_camera(known, motion_settings):
    settings = motion_settings.model_copy(update={"views": 0})
    still, moments = known.at([0] * FRAMES), torch.linspace(0, 1, FRAMES)
    truth = replace(still, means=still.means + torch.tensor([0.0, 0.0, SLIDE]) * moments[:, None, None])
    front, side = (OrbitCamera(0, azimuth, width=SIZE, height=SIZE) for azimuth in (0, 90))
    seen = known.rasterize(truth, [front] * FRAMES, torch.zeros(3))
    video = DrivingVideo(seen.color / seen.alpha.clamp(min=1e-3), seen.alpha, 8.0)
    aside = known.rasterize(truth.states([FRAMES - 1]), [side], torch.zeros(3))
    cutout = torch.cat([aside.color / aside.alpha.clamp(min=1e-3), aside.alpha], -1)[0]
    found = []
    for views in ({}, {FRAMES - 1: [KnownView(side, cutout)]}):
        deformation = make("hexplane", known)
        fit_motion(
            known.gaussians, deformation, video, known.prior(0.5), known.rasterize, settings, seed(), known=views
        )
        last = deformation.displace(known.gaussians.means, video.times[-1:]).means[0]
        found.append((last.median(0).values - torch.tensor([0.0, 0.0, SLIDE])).abs().max().item())
    assert found[1] < 0.03 and found[1] < 0.5 * found[0]


@pytest.mark.slow
def test_fine_tuning_mends_colors_and_a_frozen_cloud_keeps_its_bits(known, motion_settings):
    truth, gray = known.gaussians, replace(known.gaussians, harmonics=torch.zeros(40, 1, 3))
    wrong = (gray.colors - truth.colors).abs().mean()
    for fine_tune in (False, True):
        settings = motion_settings.model_copy(update={"fine_tune": fine_tune, "color_lr": 0.1, "iterations": 60})
        losses: list[float] = []
        fitted = fit_motion(
            gray, make("hexplane", known), known.video(), known.prior(0.5), known.rasterize, settings, seed(),
            lambda _, values, losses=losses: losses.append(values["reference"]),
        )  # fmt: skip
        assert (gray.harmonics == 0).all()  # what was given is left alone
        left = (fitted.colors - truth.colors).abs().mean()
        if fine_tune:
            assert left < 0.3 * wrong and losses[-1] < 0.05 * losses[0]
        else:
            assert losses[-1] > 0.2 * losses[0]
            assert all(torch.equal(value, getattr(gray, name)) for name, value in vars(fitted).items())


def test_fine_tuning_learns_at_the_rates_of_the_public_code(known, motion_settings):
    """The first step of Adam is the rate, whatever the gradient; in the only iteration the means' is their last."""
    turned = replace(known.gaussians, log_scales=known.gaussians.log_scales + torch.tensor([0.0, 0.3, -0.3]))
    settings = motion_settings.model_copy(update={"fine_tune": True, "iterations": 1})
    fitted = fit_motion(
        turned, make("hexplane", known), known.video(), known.prior(0.5), known.rasterize, settings, seed()
    )
    rates = {"means": 2e-5, "harmonics": 0.01, "opacity_logits": 0.05, "log_scales": 0.005, "quats": 0.005}
    for name, rate in rates.items():
        change = (getattr(fitted, name) - getattr(turned, name)).abs()
        assert change.median().item() == pytest.approx(rate, rel=0.01), name
        assert change.max() < 1.02 * rate, name
    assert (settings.means_lr, settings.means_lr_end) == (1e-3, 2e-5)


@pytest.mark.parametrize("kind", ["hexplane", "mlp"])
def test_lengths_of_another_unit_are_fitted_alike(kind: str, known, motion_settings):
    """A world that is 4/3 as large, with its learning rates of lengths, moves 4/3 as far in every iteration."""
    moved = []
    for scale in (1.0, 4 / 3):
        box = scale * bounds_of(known.gaussians)
        size = {"hidden": 16, **({"spatial": 4, "temporal": 4, "features": 8} if kind == "hexplane" else {})}
        settings = HexPlaneSettings(**size) if kind == "hexplane" else MlpSettings(frequencies=2, **size)
        deformation = new_deformation(settings, box, FRAMES, 40, seed())
        rates = motion_settings.model_copy(update={"length_scale": scale})
        adam = torch.optim.Adam(parameter_groups(deformation, rates), betas=(0.9, 0.999), eps=1e-15)
        times = torch.linspace(0, 1, FRAMES)
        slide = torch.stack([SLIDE * times, 0.1 * times.square(), torch.zeros(FRAMES)], -1)[:, None]
        for _ in range(30):
            adam.zero_grad()
            means = deformation.displace(scale * known.gaussians.means, times).means / scale
            (means - slide).square().mean().backward()
            adam.step()
        moved.append(deformation.displace(scale * known.gaussians.means, times).means.detach() / scale)
    assert moved[0].abs().max() > 0.05
    torch.testing.assert_close(moved[1], moved[0], atol=1e-4, rtol=0)


def test_fine_tuned_means_learn_at_the_rate_of_their_unit(known, motion_settings):
    settings = motion_settings.model_copy(update={"fine_tune": True, "iterations": 1, "length_scale": 4 / 3})
    fitted = fit_motion(
        known.gaussians, make("hexplane", known), known.video(), known.prior(0.5), known.rasterize, settings, seed()
    )
    for name, rate in {"means": 2e-5 * 4 / 3, "opacity_logits": 0.05}.items():
        change = (getattr(fitted, name) - getattr(known.gaussians, name)).abs()
        assert change.median().item() == pytest.approx(rate, rel=0.02), name


def test_frames_of_an_iteration_are_spread_over_time():
    for number in range(20):
        frames = sample_frames(32, 8, seed(number))
        assert [int(f) // 4 for f in frames] == list(range(8))
    assert sample_frames(5, 0, seed()).tolist() == [0, 1, 2, 3, 4]
    assert sample_frames(5, 9, seed()).tolist() == [0, 1, 2, 3, 4]


def test_a_prior_is_only_asked_what_it_can_judge(known, motion_settings):
    prior = known.prior(0.5)
    prior.frames = (0, 2)
    views, rows = sample_views(
        prior, torch.tensor([1, 2, 3]), motion_settings.model_copy(update={"views": 2}), 16, seed()
    )
    assert [view.frame for view in views] == [2, 2]
    assert rows.tolist() == [1, 1]


def test_only_some_frames_of_an_iteration_get_random_views(known, motion_settings):
    settings = motion_settings.model_copy(update={"guided_frames": 2, "views": 2})
    prior = known.prior(0.5)
    seen = set()
    for number in range(20):
        views, rows = sample_views(prior, torch.arange(FRAMES), settings, 16, seed(number))
        assert [view.frame for view in views] == rows.tolist()
        assert rows[0] == rows[1] < 2 <= rows[2] == rows[3]  # one from each half
        seen.update(rows.tolist())
    assert seen == set(range(FRAMES))


def test_the_reference_view_is_drawn_small_first(known, motion_settings):
    sizes = []

    def rasterize(gaussians, cameras, background, offsets=None):
        sizes.append(cameras[0].width)
        return known.rasterize(gaussians, cameras, background, offsets)

    early = {"reference_schedule": (ResolutionStage(until=0.5, size=16),), "iterations": 4, "views": 0}
    settings = motion_settings.model_copy(update=early)
    fit_motion(known.gaussians, make("framewise", known), known.video(), known.prior(0.5), rasterize, settings, seed())
    assert sizes == [16, 32, 32, 32]


def test_a_loss_that_is_no_number_stops_the_fit(known, motion_settings):
    video = known.video()
    video.frames[2] = torch.nan
    with pytest.raises(FitDiverged, match="fit_motion: the loss became nan at iteration 1 of 120"):
        fit_motion(
            known.gaussians, make("framewise", known), video, known.prior(0.5), known.rasterize, motion_settings, seed()
        )
