import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from dg4d_lib.errors import BadInput, FitDiverged
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.extraction.density import REACH, DensityField, density_field
from dg4d_lib.settings import MeshSettings

SMALL = MeshSettings(grid=40)


def cloud(count: int, scale: float = 0.1) -> Gaussians:
    generator = torch.Generator().manual_seed(7)
    means, quats = torch.randn(count, 3, generator=generator), torch.randn(count, 4, generator=generator)
    stretch = torch.rand(count, 3, generator=generator)
    logits = torch.randn(count, generator=generator)
    return Gaussians(0.3 * means, (scale * (1 + stretch)).log(), quats, logits, torch.zeros(count, 1, 3))


def samples(field: DensityField) -> torch.Tensor:
    steps = torch.arange(len(field.values), dtype=torch.float64) * field.cell
    return torch.stack(torch.meshgrid(*(steps + start for start in field.origin), indexing="ij"), -1)


def everything(gaussians: Gaussians, field: DensityField) -> tuple[torch.Tensor, torch.Tensor]:
    """The density without truncation, and the sum of the opacities that truncation leaves out."""
    arms = samples(field)[..., None, :] - gaussians.means.double()
    distance2 = torch.einsum("xyzni,nij,xyznj->xyzn", arms, gaussians.covariances.double().inverse(), arms)
    opacities = gaussians.opacities.double()
    left_out = (opacities * (distance2 >= REACH**2)).sum(-1)
    return (opacities * torch.exp(-0.5 * distance2)).sum(-1), left_out


def test_density_is_the_sum_of_the_gaussians_up_to_the_stated_truncation() -> None:
    gaussians = cloud(20)
    field = density_field(gaussians, SMALL)
    full, left_out = everything(gaussians, field)
    error = full - field.values
    assert error.min() > -1e-5  # float32
    assert (error - math.exp(-(REACH**2) / 2) * left_out).max() < 1e-5


def test_the_means_fill_nine_tenths_of_the_box() -> None:
    gaussians = cloud(50, scale=0.01)
    field = density_field(gaussians, SMALL)
    sides = gaussians.means.amax(0) - gaussians.means.amin(0)
    assert field.unit == pytest.approx(sides.max().item() / 1.8, rel=1e-5)
    assert field.cell * SMALL.grid == pytest.approx(2 * field.unit)


def test_large_gaussians_have_room_in_the_box() -> None:
    gaussians = cloud(5, scale=1.0)
    field = density_field(gaussians, SMALL)
    reach = 2 * gaussians.covariances.diagonal(dim1=-2, dim2=-1).sqrt()
    low, high = (gaussians.means - reach).amin(0), (gaussians.means + reach).amax(0)
    assert (low >= field.origin - field.cell).all()
    assert (high <= field.origin + SMALL.grid * field.cell).all()


@pytest.mark.parametrize("shift", [0.0, 0.25, 0.5])
def test_a_flat_gaussian_does_not_fall_between_the_samples(shift: float) -> None:
    wide = torch.tensor([[0.3, 0.3, 1e-5]]).log()
    gaussians = Gaussians(
        torch.zeros(1, 3), wide, torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([8.0]), torch.zeros(1, 1, 3)
    )
    far = replace(gaussians, means=torch.tensor([[0.0, 0.0, shift * density_field(gaussians, SMALL).cell]]))
    both = Gaussians(
        torch.cat([gaussians.means, far.means]),
        wide.repeat(2, 1),
        gaussians.quats.repeat(2, 1),
        torch.tensor([-20.0, 8.0]),  # the first, invisible one must not count
        torch.zeros(2, 1, 3),
    )
    assert density_field(both, SMALL).values.max() > 0.75


def test_order_of_the_gaussians_does_not_matter() -> None:
    gaussians = cloud(30)
    order = torch.randperm(30, generator=torch.Generator().manual_seed(1))
    turned = gaussians.subset(order)
    first, second = density_field(gaussians, SMALL), density_field(turned, SMALL)
    torch.testing.assert_close(first.values, second.values, atol=1e-5, rtol=0)


def test_faint_gaussians_do_not_count() -> None:
    gaussians = cloud(64)  # torch computes the rest of a vector, such as 10 of 32 numbers, with other last bits
    far = replace(gaussians, means=gaussians.means + 100, opacity_logits=torch.full((64,), -9.0))
    both = Gaussians(**{name: torch.cat([value, vars(far)[name]]) for name, value in vars(gaussians).items()})
    np.testing.assert_array_equal(density_field(both, SMALL).values, density_field(gaussians, SMALL).values)


def test_an_empty_model_is_refused_with_what_to_do() -> None:
    faint = replace(cloud(5), opacity_logits=torch.full((5,), -20.0))
    with pytest.raises(FitDiverged, match=r"mesh\.min_opacity.*fit it again"):
        density_field(faint, SMALL)


def test_a_model_that_is_not_finite_is_refused() -> None:
    gaussians = cloud(5)
    broken = replace(gaussians, means=torch.full_like(gaussians.means, torch.nan))
    with pytest.raises(FitDiverged, match="not finite"):
        density_field(broken, SMALL)


def test_a_batch_of_states_is_refused() -> None:
    gaussians = cloud(5)
    states = replace(
        gaussians, means=gaussians.means[None], quats=gaussians.quats[None], log_scales=gaussians.log_scales[None]
    )
    with pytest.raises(BadInput, match="one state"):
        density_field(states, SMALL)
