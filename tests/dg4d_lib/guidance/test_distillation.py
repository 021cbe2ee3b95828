import pytest
import torch

from dg4d_lib.diffusion.batching import MicroBatches
from dg4d_lib.diffusion.noise_schedule import alphas_cumprod
from dg4d_lib.guidance.distillation import (
    TimestepSchedule,
    annealed_timestep,
    distill_in_pieces,
    distillation_loss,
    sds_weight,
)


@pytest.mark.parametrize(("timestep", "expected"), [(20, 0.0187), (250, 0.326), (500, 0.724), (980, 0.994)])
def test_weights_of_the_method(timestep: int, expected: float):
    assert sds_weight(timestep) == pytest.approx(expected, rel=0.01)


def test_the_annealing_goes_from_its_start_to_two_percent():
    assert annealed_timestep(0.0, 0.98) == 980
    assert annealed_timestep(0.5, 0.98) == 500
    assert annealed_timestep(1.0, 0.98) == 20
    assert annealed_timestep(0.0, 0.5) == 500


@pytest.mark.parametrize(("timestep", "expected"), [(20, 0.0187), (250, 0.326), (500, 0.724), (980, 0.994)])
def test_weights_to_the_digits_that_are_written_down(timestep: int, expected: float):
    digits = len(str(expected)) - 2
    assert round(sds_weight(timestep), digits) == expected


@pytest.mark.parametrize(("start", "iterations"), [(0.98, 500), (0.5, 200)])
def test_the_papers_timesteps(start: float, iterations: int):
    generator = torch.Generator()
    for i in range(1, iterations + 1):
        s = i / iterations
        expected = round(1000 * (start + (0.02 - start) * s))
        assert TimestepSchedule(start).timestep(s, generator) == expected


def test_the_timesteps_of_the_public_code():
    generator = torch.Generator()
    found = [TimestepSchedule(1.0, 0.0).timestep(i / 500, generator) for i in range(1, 501)]
    assert found == [min(max(round(1000 * (1 - i / 500)), 20), 980) for i in range(1, 501)]
    assert set(found[:10]) == {980} and found[10] == 978
    assert found[488] == 22 and set(found[489:]) == {20}


def test_the_timesteps_of_the_first_release_stay_at_their_limit_for_half_of_the_fit():
    generator = torch.Generator()
    found = [TimestepSchedule(1.0, 0.0, 0.5).timestep(i / 200, generator) for i in range(1, 201)]
    assert found == [min(max(round(1000 * (1 - i / 200)), 20), 500) for i in range(1, 201)]
    assert set(found[:100]) == {500} and found[100] == 495 and found[-1] == 20
    assert sum(found) / 200 == pytest.approx(374, abs=1)  # the paper's words give 259
    literal = [TimestepSchedule(0.5).timestep(i / 200, generator) for i in range(1, 201)]
    assert sum(literal) / 200 == pytest.approx(259, abs=1)


def test_a_schedule_without_draws_leaves_the_generator_alone():
    generator = torch.Generator().manual_seed(1)
    TimestepSchedule(0.98).timestep(0.3, generator)
    assert torch.equal(generator.get_state(), torch.Generator().manual_seed(1).get_state())


def test_uniform_timesteps_fill_the_stretch_below_the_highest():
    generator = torch.Generator().manual_seed(0)
    draws = [TimestepSchedule(0.98, uniform=True).timestep(0.9, generator) for _ in range(4000)]
    highest = annealed_timestep(0.9, 0.98)
    assert (min(draws), max(draws)) == (20, highest)
    assert sum(draws) / len(draws) == pytest.approx((20 + highest) / 2, rel=0.02)
    assert [TimestepSchedule(0.98, uniform=True).timestep(1.0, generator) for _ in range(5)] == [20] * 5


@pytest.mark.parametrize("size", [1, 2, 3, 8])
def test_pieces_have_the_loss_and_the_gradient_of_the_whole(size: int):
    generator = torch.Generator().manual_seed(0)
    images = torch.rand(5, 16, 16, 3, generator=generator, dtype=torch.float64)
    noise = torch.randn(5, 3, 8, 8, generator=generator, dtype=torch.float64)
    offsets = torch.randn(5, 3, 8, 8, generator=generator, dtype=torch.float64)

    def encode(pixels: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.avg_pool2d(pixels.permute(0, 3, 1, 2), 2).sin()

    def predict(noisy: torch.Tensor, t: int, piece: slice = slice(None)) -> torch.Tensor:
        return noisy.tanh() * t / 1000 + offsets[piece]

    whole, pieces = images.clone().requires_grad_(), images.clone().requires_grad_()
    expected = distillation_loss(encode(whole), predict, 300, noise)
    found = distill_in_pieces(pieces, encode, predict, 300, noise, MicroBatches("images", size))
    (3 * expected).backward()
    (3 * found).backward()
    torch.testing.assert_close(found, expected)
    torch.testing.assert_close(pieces.grad, whole.grad)


@pytest.mark.parametrize("size", [1, 2])
@pytest.mark.parametrize("broken", [1, 2])
def test_the_loss_is_not_a_number_if_no_predicted_noise_is(broken: int, size: int):
    def predict(noisy: torch.Tensor, t: int, piece: slice) -> torch.Tensor:
        return torch.tensor([torch.nan] * broken + [0.5] * (2 - broken))[piece, None, None, None].expand_as(noisy)

    images, noise = torch.rand(2, 4, 4, 3), torch.ones(2, 3, 4, 4)
    batches = MicroBatches("images", size)
    loss = distill_in_pieces(images, lambda pixels: pixels.movedim(-1, 1), predict, 500, noise, batches)
    assert bool(loss.isnan()) == (broken == 2)


@pytest.mark.parametrize("timestep", [20, 500, 980])
def test_the_gradient_is_the_weighted_difference_of_noises(timestep: int):
    latents = torch.randn(2, 4, 8, 8, generator=torch.Generator().manual_seed(0), requires_grad=True)
    seen = []

    def predict(noisy: torch.Tensor, t: int) -> torch.Tensor:
        seen.append((noisy, t))
        return torch.full_like(noisy, 0.25)

    noise = torch.randn(latents.shape, generator=torch.Generator().manual_seed(7))
    distillation_loss(latents, predict, timestep, noise).backward()
    alphabar = alphas_cumprod()[timestep].float()
    torch.testing.assert_close(seen[0][0], alphabar.sqrt() * latents.detach() + (1 - alphabar).sqrt() * noise)
    assert seen[0][1] == timestep
    torch.testing.assert_close(latents.grad, sds_weight(timestep) * (0.25 - noise) / 2, atol=1e-6, rtol=1e-5)


def test_no_gradient_flows_through_the_denoiser():
    latents = torch.zeros(1, 1, 2, 2, requires_grad=True)
    scale = torch.ones((), requires_grad=True)
    distillation_loss(latents, lambda noisy, t: noisy * scale, 500, torch.ones_like(latents)).backward()
    assert scale.grad is None


def test_noise_that_is_not_a_number_pulls_nowhere():
    latents = torch.zeros(1, 1, 2, 2, requires_grad=True)
    noise = torch.ones_like(latents)
    distillation_loss(latents, lambda noisy, t: torch.full_like(noisy, torch.nan), 500, noise).backward()
    assert torch.equal(latents.grad, torch.zeros_like(latents))
