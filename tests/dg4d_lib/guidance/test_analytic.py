import pytest
import torch

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.diffusion.noise_schedule import alphas_cumprod
from dg4d_lib.guidance.analytic import AnalyticPrior
from dg4d_lib.guidance.distillation import TimestepSchedule, annealed_timestep, distillation_loss
from dg4d_lib.guidance.interface import GuidancePrior, GuidanceView

SIZE = 12
LATENT_NUMBERS = 4 * 32 * 32  # of Zero-1-to-3
VIEWS = [GuidanceView(OrbitCamera(width=SIZE, height=SIZE))] * 3


def known_pictures() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    return torch.rand(3, SIZE, SIZE, 3, generator=generator), torch.rand(3, SIZE, SIZE, 1, generator=generator)


def prior() -> AnalyticPrior:
    return AnalyticPrior(lambda views: known_pictures(), TimestepSchedule(0.98))


def test_it_is_a_guidance_prior():
    assert isinstance(prior(), GuidancePrior)


@pytest.mark.parametrize("progress", [0.0, 0.4, 1.0])
def test_the_gradient_is_that_of_score_distillation_whatever_its_noise(progress: float):
    images = torch.full((3, SIZE, SIZE, 3), 0.5, requires_grad=True)
    coverage = torch.full((3, SIZE, SIZE, 1), 0.5, requires_grad=True)
    prior().loss(images, coverage, VIEWS, progress, torch.Generator().manual_seed(0)).backward()
    timestep = annealed_timestep(progress, 0.98)
    alphabar = float(alphas_cumprod()[timestep])
    known = (2 * torch.cat(known_pictures(), -1) - 1).permute(0, 3, 1, 2)
    pixels = torch.full((3, SIZE, SIZE, 4), 0.5, requires_grad=True)
    noise = torch.randn(known.shape, generator=torch.Generator().manual_seed(1))
    drawn = distillation_loss(
        2 * pixels.permute(0, 3, 1, 2) - 1,
        lambda noisy, _: (noisy - alphabar**0.5 * known) / (1 - alphabar) ** 0.5,
        timestep,
        noise,
    )
    (drawn * LATENT_NUMBERS / (3 * SIZE * SIZE)).backward()
    torch.testing.assert_close(torch.cat([images.grad, coverage.grad], -1), pixels.grad, atol=2e-4, rtol=1e-3)


def test_free_pixels_converge_to_the_known_picture():
    images = torch.full((3, SIZE, SIZE, 3), 0.5, requires_grad=True)
    coverage = torch.full((3, SIZE, SIZE, 1), 0.5, requires_grad=True)
    adam = torch.optim.Adam([images, coverage], lr=0.02)
    generator = torch.Generator().manual_seed(0)
    for step in range(300):
        adam.zero_grad()
        prior().loss(images, coverage, VIEWS, step / 300, generator).backward()
        adam.step()
    color, alpha = known_pictures()
    assert (images - color).abs().max() < 0.01
    assert (coverage - alpha).abs().max() < 0.01


def test_frames_have_their_own_weights():
    def loss(frame: int, **weights) -> float:
        known = AnalyticPrior(lambda views: known_pictures(), TimestepSchedule(0.98), **weights)
        views = [GuidanceView(VIEWS[0].camera, frame)] * 3
        images = torch.zeros(3, SIZE, SIZE, 3)
        return float(known.loss(images, images[..., :1], views, 0.5, torch.Generator()))

    weights = {"weight": 0.25, "weights": {0: 1.0}}
    assert loss(0, **weights) == pytest.approx(loss(0))
    assert loss(5, **weights) == pytest.approx(loss(0) / 4)
