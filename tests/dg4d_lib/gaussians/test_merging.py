"""Merging of Gaussians: moments, looks, colors, counts."""

import math
from dataclasses import replace

import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.merging import merge_gaussians
from dg4d_lib.gaussians.transform import thinned
from dg4d_lib.rasterizer.interface import get_rasterizer

SIDE = 40


def card(opacity: float = 0.95) -> Gaussians:
    """Return a square of SIDE x SIDE Gaussians with stripes, facing the camera."""
    line = torch.linspace(-0.5, 0.5, SIDE)
    means = torch.cartesian_prod(line, line, torch.zeros(1))
    count = len(means)
    colors = torch.stack([(6 * means[:, 0]).sin(), (5 * means[:, 1]).cos(), means[:, 0]], 1)
    return Gaussians(
        means,
        torch.full((count, 3), math.log(0.5 / SIDE)),
        torch.tensor([1.0, 0, 0, 0]).expand(count, 4).contiguous(),
        torch.full((count,), opacity).logit(),
        colors[:, None],
    )


def pair(offset: float, opacities: tuple[float, float] = (0.5, 0.5), colors: tuple[float, float] = (0, 1)) -> Gaussians:
    return Gaussians(
        torch.tensor([[-offset, 0.0, 0.0], [offset, 0.0, 0.0]]),
        torch.full((2, 3), math.log(0.1)),
        torch.tensor([[1.0, 0, 0, 0]] * 2),
        torch.tensor(opacities).logit(),
        torch.tensor(colors)[:, None, None].expand(2, 1, 3).float().contiguous(),
    )


def test_a_pair_becomes_its_moments() -> None:
    merged = merge_gaussians(pair(0.3, (0.2, 0.6)), 1)
    torch.testing.assert_close(merged.means, torch.tensor([[0.15, 0.0, 0.0]]))
    between = 0.25 * 0.45**2 + 0.75 * 0.15**2
    torch.testing.assert_close(merged.covariances[0], torch.diag(torch.tensor([0.01 + between, 0.01, 0.01])))
    torch.testing.assert_close(merged.harmonics, torch.full((1, 1, 3), 0.75))


def test_two_at_one_place_are_as_opaque_as_both() -> None:
    torch.testing.assert_close(merge_gaussians(pair(0.0, (0.2, 0.3)), 1).opacities, torch.tensor([0.44]))
    assert merge_gaussians(pair(0.0, (0.9, 0.9)), 1).opacities.item() == pytest.approx(0.99)


def test_a_merged_pair_covers_the_union_of_both() -> None:
    """Two balls two standard deviations apart become a spheroid with axes in the ratio of 1 to the root of 2."""
    area = 0.1**2 * (1 + math.pi / 2) / 2  # of the spheroid, over 4 pi
    covered = 0.1**2 * (0.5 + 0.5 - 0.5 * 0.5 * math.exp(-1))
    assert merge_gaussians(pair(0.1), 1).opacities.item() == pytest.approx(covered / area, rel=2e-3)


@pytest.mark.parametrize("step", [4, 10])
def test_merged_clouds_look_alike(step: int) -> None:
    cloud, camera = card(), OrbitCamera(width=96, height=96)

    def render(one: Gaussians) -> torch.Tensor:
        return get_rasterizer("cpu")(one, [camera], torch.ones(3)).color

    merged = merge_gaussians(cloud, len(cloud) // step)
    assert len(merged) == len(cloud) // step
    ours, theirs = ((render(one) - render(cloud)).square().mean() for one in (merged, thinned(cloud, step)))
    assert ours < 0.25 * theirs
    assert ours < 0.004


def test_different_colors_stay_apart() -> None:
    cloud = card()
    second = replace(cloud, means=cloud.means + 0.002, harmonics=torch.full_like(cloud.harmonics, -1.0))
    first = replace(cloud, harmonics=torch.ones_like(cloud.harmonics))
    both = Gaussians(**{name: torch.cat([value, vars(second)[name]]) for name, value in vars(first).items()})
    assert merge_gaussians(both, 400).harmonics.abs().min() == pytest.approx(1.0, abs=1e-5)


def test_what_is_not_drawn_goes_first() -> None:
    cloud = card()
    cloud.opacity_logits[::2] = -9.0
    merged = merge_gaussians(cloud, len(cloud) // 2)
    assert torch.equal(merged.means, cloud.means[1::2])


def test_clouds_that_are_small_enough_stay() -> None:
    cloud = card()
    assert merge_gaussians(cloud, len(cloud)) is cloud


@pytest.mark.parametrize(
    "cloud",
    [
        replace(card(), means=torch.zeros(SIDE**2, 3)),
        replace(card(), means=torch.ones(SIDE**2, 3)),
        replace(card(), log_scales=torch.full((SIDE**2, 3), 300.0)),
        replace(card(), log_scales=torch.full((SIDE**2, 3), -300.0)),
        replace(card(), means=1e30 * card().means),
        card(1e-6),
        replace(card(), opacity_logits=torch.full((SIDE**2,), -1000.0)),
    ],
    ids=["origin", "one place", "huge", "tiny", "far apart", "faint", "invisible"],
)
def test_degenerate_clouds_are_merged(cloud: Gaussians) -> None:
    merged = merge_gaussians(cloud, 7)
    assert len(merged) == 7
    assert all(value.isfinite().all() for value in vars(merged).values())
