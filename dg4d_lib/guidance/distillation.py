"""Score distillation: one code path for every prior (Poole et al. 2023; paper section 3.1).

alphabar is Stable Diffusion's schedule; z are clean latents (or pixels, for analytic denoisers), e the noise:
x_t = sqrt(alphabar) z + sqrt(1 - alphabar) e;  grad = (1 - alphabar) (e_predicted - e);  d loss / d z = grad / images.
"""

from collections.abc import Callable
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

TRAIN_STEPS = 1000
BETA_START, BETA_END = 0.00085, 0.012  # scaled-linear
NOISE_END = 0.02  # share of the schedule at which the annealing ends

PredictNoise = Callable[[Float[Tensor, "b c h w"], int], Float[Tensor, "b c h w"]]


@cache
def alphabars() -> Float[Tensor, " steps"]:
    """Products of 1 - beta, float64, one per training step."""
    betas = torch.linspace(BETA_START**0.5, BETA_END**0.5, TRAIN_STEPS, dtype=torch.float64).square()
    return (1 - betas).cumprod(0)


def annealed_timestep(progress: float, noise_start: float) -> int:
    """The one timestep of an iteration: linear from `noise_start` down to 0.02 of the schedule.

    Args:
        progress: share of the optimization that is done, in [0, 1].
        noise_start: 0.98 in the static stage, 0.5 in the dynamic stage (paper).
    """
    share = noise_start + (NOISE_END - noise_start) * progress
    return min(max(round(TRAIN_STEPS * share), round(TRAIN_STEPS * NOISE_END)), round(TRAIN_STEPS * 0.98))


def weight(timestep: int) -> float:
    """w(t) = 1 - alphabar(t): 0.0187 at 20, 0.326 at 250, 0.724 at 500, 0.994 at 980."""
    return 1.0 - float(alphabars()[timestep])


def score_distillation(
    latents: Float[Tensor, "b c h w"], predict_noise: PredictNoise, timestep: int, generator: torch.Generator
) -> Float[Tensor, ""]:
    """The distillation loss, divided by the number of images.

    Args:
        latents: z, with gradient.
        predict_noise: (x_t, t) -> the noise it believes in; called without gradient.
        timestep: t, one for the batch.
        generator: the source of e.
    """
    alphabar = float(alphabars()[timestep])
    with torch.no_grad():
        noise = torch.empty_like(latents, memory_format=torch.contiguous_format).normal_(generator=generator)
        noisy = alphabar**0.5 * latents + (1 - alphabar) ** 0.5 * noise
        gradient = torch.nan_to_num(weight(timestep) * (predict_noise(noisy, timestep) - noise))
        target = latents - gradient
    return 0.5 * (latents - target).square().sum() / len(latents)
