import pytest
import torch

from dg4d_lib.errors import FitDiverged
from dg4d_lib.fitting.losses import Diverged, check_finite, reference_loss, resize_cutouts
from dg4d_lib.gaussians.initialize import blob
from dg4d_lib.rasterizer.interface import Rendering


def test_resizing_is_over_white_and_does_not_bleed_hidden_color():
    cutout = torch.zeros(1, 8, 8, 4)
    cutout[..., :3] = torch.tensor([0.0, 1.0, 0.0])  # green everywhere, also where it is transparent
    cutout[:, :, :4, 3] = 1.0
    color, alpha = resize_cutouts(cutout, 4)
    torch.testing.assert_close(alpha[0, :, 0], torch.ones(4, 1))
    torch.testing.assert_close(color[0, :, 3], torch.ones(4, 3))
    torch.testing.assert_close(color[0, :, 0], torch.tensor([[0.0, 1.0, 0.0]]).expand(4, 3))


@pytest.mark.parametrize(("height", "width"), [(4, 8), (8, 4), (4, 4)])
def test_cutouts_become_square_also_where_one_side_fits_already(height: int, width: int):
    color, alpha = resize_cutouts(torch.ones(2, height, width, 4), 4)
    torch.testing.assert_close(color, torch.ones(2, 4, 4, 3))
    torch.testing.assert_close(alpha, torch.ones(2, 4, 4, 1))


def test_the_reference_loss_is_its_two_weighted_means():
    rendering = Rendering(
        torch.full((2, 4, 4, 3), 0.5), torch.full((2, 4, 4, 1), 0.5), torch.zeros(2, 4, 4, 1), torch.ones(2, 1).bool()
    )
    loss = reference_loss(rendering, torch.zeros(2, 4, 4, 3), torch.ones(2, 4, 4, 1), 8.0, 4.0)
    torch.testing.assert_close(loss, torch.tensor(8 * 0.25 + 4 * 0.25))


def test_structural_similarity_counts_when_it_has_a_weight():
    color = torch.rand(2, 12, 12, 3, generator=torch.Generator().manual_seed(0))
    nothing = torch.zeros(2, 12, 12, 1)
    rendering = Rendering(color.clone().requires_grad_(), nothing, nothing, torch.ones(2, 1).bool())
    torch.testing.assert_close(reference_loss(rendering, color, nothing, 1.0, 1.0, 5.0), torch.tensor(0.0))
    loss = reference_loss(rendering, 1 - color, nothing, 0.0, 0.0, 5.0)
    assert 5 < loss < 10  # opposite pictures: similarity below zero
    loss.backward()
    assert rendering.color.grad is not None and rendering.color.grad.abs().sum() > 0


@pytest.mark.parametrize(
    ("reference", "guidance", "advice"),
    [
        (1.0, torch.nan, "set prior.precision=bf16 or fp32"),
        (1.0, torch.inf, "set prior.precision=bf16 or fp32"),
        (torch.nan, torch.nan, "lower the learning rates"),
        (torch.nan, 1.0, "lower the learning rates"),
    ],
)
def test_the_advice_is_for_what_diverged(reference, guidance, advice):
    losses = {name: torch.tensor(value) for name, value in (("reference", reference), ("guidance", guidance))}
    losses["loss"] = losses["reference"] + losses["guidance"]
    cloud = blob(9, 0.5, torch.Generator().manual_seed(0))
    with pytest.raises(FitDiverged, match=f"; .*{advice}"):
        check_finite("fit", losses, [torch.zeros(3)], "iteration 1 of 2", "lower the learning rates", cloud)


@pytest.mark.parametrize("broken", [torch.inf, torch.nan])
def test_a_gradient_that_is_no_number_stops_the_fit(broken):
    cloud = blob(9, 0.5, torch.Generator().manual_seed(0))
    losses = {"loss": torch.tensor(2.5), "reference": torch.tensor(1.0)}
    numbers = check_finite("fit", losses, [None, torch.zeros(3)], "iteration 1 of 2", "rest", cloud)
    assert numbers == {"loss": 2.5, "reference": 1.0}
    slopes = [None, torch.zeros(4), torch.tensor([1.0, broken])]
    with pytest.raises(FitDiverged, match=f"fit: the gradient became {broken} at iteration 1 of 2; rest") as caught:
        check_finite("fit", losses, slopes, "iteration 1 of 2", "rest", cloud)
    assert isinstance(caught.value, Diverged)
    assert len(caught.value.gaussians) == 9
