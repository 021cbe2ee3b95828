import math

import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.cameras.viewpoints import random_orbit
from dg4d_lib.errors import FitDiverged
from dg4d_lib.fitting.losses import Diverged
from dg4d_lib.fitting.static import _Cloud, background, fit_gaussians, learning_rates
from dg4d_lib.gaussians.initialize import blob
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.visual_hull.known import KnownView


def seed(number: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(number)


def psnr_from_unseen_sides(known, gaussians) -> float:
    views = [GuidanceView(c) for c in random_orbit(8, 32, elevation_deg=(-30, 30), radius=(2, 2), generator=seed(99))]
    with torch.no_grad():
        color = known.rasterize(gaussians, [view.camera for view in views], torch.ones(3)).color
    return float(-10 * (color - known.clean(views)[0]).square().mean().log10())


def test_score_distillation_with_the_true_views_recovers_the_object(known, static_settings):
    start = blob(static_settings.start.points, 0.5, seed())
    seen = []
    fitted = fit_gaussians(
        start,
        known.subject(),
        known.prior(0.98),
        known.rasterize,
        static_settings,
        seed(),
        lambda i, v: seen.append((i, v)),
    )
    assert psnr_from_unseen_sides(known, fitted) > psnr_from_unseen_sides(known, start) + 8
    assert [i for i, _ in seen] == list(range(1, static_settings.iterations + 1))
    assert not fitted.means.requires_grad


def test_known_pictures_of_other_sides_are_fitted_without_a_prior(known, static_settings):
    alone = static_settings.model_copy(update={"guidance_weight": 0.0})
    start = blob(static_settings.start.points, 0.5, seed())
    camera = OrbitCamera(0, 90, width=32, height=32)
    color, alpha = known.clean([GuidanceView(camera)])
    cutout = torch.cat([(color - 1 + alpha) / alpha.clamp(min=1e-3), alpha], -1)[0]
    errors = []
    for sides in ([], [KnownView(camera, cutout)]):
        fitted = fit_gaussians(start, known.subject(), known.prior(0.98), known.rasterize, alone, seed(), known=sides)
        with torch.no_grad():
            drawn = known.rasterize(fitted, [camera], torch.ones(3)).color
        errors.append(float((drawn - color).square().mean()))
    assert errors[1] < errors[0] / 4


def test_the_same_seed_gives_the_same_bytes(known, static_settings):
    short = static_settings.model_copy(
        update={"iterations": 12, "densify_every": 5, "densify_gradient": 1e-6, "prune_scale": 1.0}
    )
    start = blob(100, 0.5, seed())
    first, second = (
        fit_gaussians(start, known.subject(), known.prior(0.98), known.rasterize, short, seed(3)) for _ in range(2)
    )
    assert all(torch.equal(a, b) for a, b in zip(vars(first).values(), vars(second).values(), strict=True))


def test_the_cloud_grows_where_the_picture_pulls_and_keeps_its_limit(known, static_settings):
    eager = static_settings.model_copy(
        update={
            "iterations": 12,
            "densify_every": 5,
            "densify_gradient": 1e-9,
            "max_points": 130,
            "prune_opacity": 1e-6,
            "prune_scale": 1.0,
        }
    )
    grown = fit_gaussians(blob(100, 0.3, seed()), known.subject(), known.prior(0.98), known.rasterize, eager, seed())
    assert 100 < len(grown) <= 130


def test_a_larger_start_is_thinned_to_the_limit(known, static_settings):
    limited = static_settings.model_copy(update={"iterations": 0, "max_points": 100})
    start = blob(300, 0.3, seed())
    start = start.subset(start.means[:, 0].argsort())  # from left to right
    start.opacity_logits[::5] += 1
    fitted = fit_gaussians(start, known.subject(), known.prior(0.98), known.rasterize, limited, seed())
    assert len(fitted) == 100
    opaque = fitted.opacity_logits == start.opacity_logits.max()
    assert int(opaque.sum()) == 60
    assert fitted.means[~opaque, 0].mean().abs() < 0.1  # not the first of the others, which lie on one side
    same = fit_gaussians(start, known.subject(), known.prior(0.98), known.rasterize, limited, seed())
    assert torch.equal(fitted.means, same.means)


def test_a_loss_that_is_no_number_stops_with_step_iteration_and_the_last_good_state(known, static_settings):
    class Broken:
        viewpoints, frames = None, None

        def loss(self, images, coverage, views, progress, generator):
            return images.sum() * (torch.nan if progress > 0.02 else 1.0)

    with pytest.raises(FitDiverged, match="fit_gaussians: the loss became nan at iteration 4 of 150") as caught:
        fit_gaussians(blob(50, 0.5, seed()), known.subject(), Broken(), known.rasterize, static_settings, seed())
    assert isinstance(caught.value, Diverged)
    assert torch.isfinite(caught.value.gaussians.means).all()


def test_a_cloud_that_vanishes_is_an_error_not_an_empty_asset(known, static_settings):
    greedy = static_settings.model_copy(update={"densify_every": 2, "prune_opacity": 0.999})
    with pytest.raises(
        FitDiverged, match=r"0 Gaussians are left at iteration 2 of 150, .* lower static\.prune_opacity"
    ):
        fit_gaussians(blob(50, 0.5, seed()), known.subject(), known.prior(0.98), known.rasterize, greedy, seed())


def test_a_cloud_that_flies_away_is_an_error_of_this_stage(known, static_settings):
    fast = static_settings.model_copy(update={"iterations": 2, "means_lr": 1e30, "means_lr_end": 1e30})
    with pytest.raises(FitDiverged, match=r"e\+30 world units, at most 100 are allowed; lower .*static\.\*_lr"):
        fit_gaussians(blob(50, 0.5, seed()), known.subject(), known.prior(0.98), known.rasterize, fast, seed())


@pytest.mark.parametrize(("iterations", "left"), [(10, 60), (7, 100)])
def test_the_last_iteration_prunes_and_adds_nothing(iterations: int, left: int, known, static_settings):
    """As DreamGaussian after its last iteration, where the limit of the scale is twice that of densification.

    A fit too short for any density control is left alone.
    """
    due = static_settings.model_copy(update={"iterations": iterations, "densify_every": 10, "densify_gradient": 1e-9})
    start = blob(100, 0.3, seed())
    start.opacity_logits[:30] = -20.0
    start.log_scales[30:40] = 0.0  # standard deviations of 1, above the limit
    start.log_scales[40:] = math.log(0.07)  # between both limits
    fitted = fit_gaussians(start, known.subject(), known.prior(0.98), known.rasterize, due, seed())
    assert len(fitted) == left
    if left < len(start):
        assert (fitted.opacities >= due.prune_opacity).all()
        assert (fitted.scales <= 2 * due.prune_scale).all() and (fitted.scales > due.prune_scale).any()


def test_a_reset_of_the_opacities_clears_their_moments_and_no_others(known, static_settings):
    start = blob(60, 0.3, seed())
    start.opacity_logits[:] = 2.0
    cloud = _Cloud.of(start, learning_rates(static_settings))
    sum((value - 1).square().sum() for value in vars(cloud.gaussians).values()).backward()
    cloud.adam.step()
    cloud.reset_opacity()
    torch.testing.assert_close(cloud.gaussians.opacities, torch.full((60,), 0.01))
    for name, parameter in cloud.parameters.items():
        moments = [cloud.adam.state[parameter][key] for key in ("exp_avg", "exp_avg_sq")]
        assert all(bool(moment.any()) == (name != "opacity_logits") for moment in moments), name
    cloud.adam.zero_grad()
    cloud.parameters["opacity_logits"].grad = torch.zeros(60)
    before = cloud.parameters["opacity_logits"].detach().clone()
    cloud.adam.step()
    assert torch.equal(cloud.parameters["opacity_logits"], before)  # old moments would have lowered them on


def test_a_random_background_is_black_every_other_time_and_only_behind_random_views(known, static_settings):
    seen = {}

    def watching(gaussians, cameras, color, offsets=None):
        seen.setdefault(len(cameras), []).append(color.unique().item())
        return known.rasterize(gaussians, cameras, color, offsets)

    settings = static_settings.model_copy(update={"iterations": 60, "densify_every": 100, "background": "random"})
    start = blob(50, 0.5, seed())
    fit_gaussians(start, known.subject(), known.prior(0.98), watching, settings, seed())
    assert set(seen[1]) == {1.0} and set(seen[4]) == {0.0, 1.0}
    assert 18 <= seen[4].count(0.0) <= 42  # three standard deviations around a half


def test_a_white_background_draws_no_lots(static_settings):
    generator = seed()
    before = generator.get_state()
    assert (background(static_settings, generator) == 1).all()
    assert torch.equal(generator.get_state(), before)
