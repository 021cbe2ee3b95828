from dataclasses import replace

import pytest
import torch

from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.density_control import Grad2dStats, densify, prune, reset_opacity
from dg4d_lib.gaussians.initialize import isotropic


def cloud(scales: list[float], opacity: float = 0.5) -> Gaussians:
    n = len(scales)
    means = torch.arange(n, dtype=torch.float32)[:, None].expand(n, 3)
    return isotropic(means, torch.tensor(scales), torch.full((n, 3), 0.5), opacity)


def grown(scales: list[float], pull: list[float], room: int = 100):
    return densify(cloud(scales), torch.tensor(pull), 0.05, 0.05, room, torch.Generator().manual_seed(0))


def test_nothing_grows_without_a_pull():
    result = grown([0.01, 0.1], [0.0, 0.01])
    assert result.source.tolist() == [0, 1]
    assert not result.is_new.any()


def test_small_gaussians_are_cloned_in_place():
    result = grown([0.01, 0.01], [1.0, 0.0])
    assert result.source.tolist() == [0, 1, 0]
    assert result.is_new.tolist() == [False, False, True]
    torch.testing.assert_close(result.gaussians.means[2], result.gaussians.means[0])


def test_large_gaussians_split_into_two_smaller_ones():
    result = grown([0.16, 0.01], [1.0, 0.0])
    assert result.source.tolist() == [1, 0, 0]
    torch.testing.assert_close(result.gaussians.scales[1:], torch.full((2, 3), 0.1))
    assert (result.gaussians.means[1] - result.gaussians.means[2]).norm() > 0


def test_the_halves_of_a_flat_gaussian_stay_in_its_plane():
    """A disk whose normal, its own z axis, is the x axis of the world: the turn takes x to y, y to z and z to x."""
    disk = replace(
        cloud([0.1] * 8),
        log_scales=torch.tensor([0.1, 0.1, 1e-12]).log().expand(8, 3),
        quats=torch.full((8, 4), 0.5),
    )
    result = densify(disk, torch.ones(8), 0.05, 0.05, 100, torch.Generator().manual_seed(0))
    moved = result.gaussians.means - disk.means[result.source]
    assert moved[:, 0].abs().max() < 1e-6
    assert moved[:, 1:].abs().max(0).values.gt(0.05).all()


def test_growth_keeps_to_its_room_and_prefers_the_strongest_pull():
    assert grown([0.01, 0.01, 0.01], [0.1, 0.9, 0.5], room=1).source.tolist() == [0, 1, 2, 1]
    assert grown([0.01], [1.0], room=0).source.tolist() == [0]
    assert grown([0.01], [1.0], room=-5).source.tolist() == [0]


def test_pruning_removes_the_faint_and_the_huge():
    assert prune(cloud([0.01, 0.2]), 0.01, 0.05).source.tolist() == [0]
    assert len(prune(cloud([0.01], opacity=0.005), 0.01, 0.05).gaussians) == 0


def test_a_reset_only_lowers_opacities():
    assert reset_opacity(cloud([0.1], 0.9)).opacities.item() == pytest.approx(0.01)
    assert reset_opacity(cloud([0.1], 0.004)).opacities.item() == pytest.approx(0.004)


def test_screen_gradients_are_averaged_over_the_views_that_saw_them():
    gradients = Grad2dStats.zeros(2)
    pixel = torch.tensor([[[3.0, 4.0], [1.0, 0.0]], [[0.0, 0.0], [9.0, 9.0]]])
    gradients.add(pixel, torch.tensor([[True, True], [True, False]]), size=128)
    torch.testing.assert_close(gradients.mean, torch.tensor([5.0 * 64 / 2, 64.0]))


def test_a_gaussian_that_no_view_saw_has_no_screen_gradient():
    gradients = Grad2dStats.zeros(1)
    gradients.add(torch.ones(1, 1, 2), torch.tensor([[False]]), size=128)
    assert gradients.mean.tolist() == [0.0]
