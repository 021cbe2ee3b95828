import pytest
import torch

from dg4d_lib.guidance.distillation import alphabars, annealed_timestep, score_distillation, weight


@pytest.mark.parametrize(("timestep", "expected"), [(20, 0.0187), (250, 0.326), (500, 0.724), (980, 0.994)])
def test_weights_of_the_method(timestep: int, expected: float):
    assert weight(timestep) == pytest.approx(expected, rel=0.01)


def test_the_annealing_goes_from_its_start_to_two_percent():
    assert annealed_timestep(0.0, 0.98) == 980
    assert annealed_timestep(0.5, 0.98) == 500
    assert annealed_timestep(1.0, 0.98) == 20
    assert annealed_timestep(0.0, 0.5) == 500


@pytest.mark.parametrize("timestep", [20, 500, 980])
def test_the_gradient_is_the_weighted_difference_of_noises(timestep: int):
    latents = torch.randn(2, 4, 8, 8, generator=torch.Generator().manual_seed(0), requires_grad=True)
    seen = []

    def predict(noisy: torch.Tensor, t: int) -> torch.Tensor:
        seen.append((noisy, t))
        return torch.full_like(noisy, 0.25)

    score_distillation(latents, predict, timestep, torch.Generator().manual_seed(7)).backward()
    noise = torch.empty_like(latents).normal_(generator=torch.Generator().manual_seed(7))
    alphabar = alphabars()[timestep].float()
    torch.testing.assert_close(seen[0][0], alphabar.sqrt() * latents.detach() + (1 - alphabar).sqrt() * noise)
    assert seen[0][1] == timestep
    torch.testing.assert_close(latents.grad, weight(timestep) * (0.25 - noise) / 2, atol=1e-6, rtol=1e-5)


def test_no_gradient_flows_through_the_denoiser():
    latents = torch.zeros(1, 1, 2, 2, requires_grad=True)
    scale = torch.ones((), requires_grad=True)
    score_distillation(latents, lambda noisy, t: noisy * scale, 500, torch.Generator().manual_seed(0)).backward()
    assert scale.grad is None


def test_noise_that_is_not_a_number_pulls_nowhere():
    latents = torch.zeros(1, 1, 2, 2, requires_grad=True)
    score_distillation(
        latents, lambda noisy, t: torch.full_like(noisy, torch.nan), 500, torch.Generator().manual_seed(0)
    ).backward()
    assert torch.equal(latents.grad, torch.zeros_like(latents))
