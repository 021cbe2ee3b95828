"""Noise schedule of Stable Diffusion, and the deterministic DDIM sampler (Song et al. 2021, eta = 0)."""

import json
import math
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput

NUM_TRAIN_TIMESTEPS = 1000
BETA_START, BETA_END = 0.00085, 0.012  # scaled-linear, Stable Diffusion v1
LOWEST_FIRST_TIMESTEP = 901  # a sampler starts from pure noise; alphabar is 0.014 there; the first of 10 steps


@dataclass(frozen=True)
class BetaSchedule:
    """Noise schedule and prediction type of a model, with the field names of diffusers.

    Attributes:
        beta_start: first beta.
        beta_end: last beta.
        beta_schedule: spacing in between.
        num_train_timesteps: number of betas.
        prediction_type: output of the network.
        trained_betas: the configuration lists the betas, in place of the four fields above.
        rescale_betas_zero_snr: the betas are rescaled, so that the last timestep is pure noise (Lin et al. 2023).
    """

    beta_start: float
    beta_end: float
    beta_schedule: str
    num_train_timesteps: int
    prediction_type: str
    trained_betas: bool = False
    rescale_betas_zero_snr: bool = False


SCHEDULE = BetaSchedule(BETA_START, BETA_END, "scaled_linear", NUM_TRAIN_TIMESTEPS, "epsilon")


@cache
def alphas_cumprod() -> Float[Tensor, " steps"]:
    """Return the cumulative products of 1 - beta, one per training timestep, float64."""
    betas = torch.linspace(BETA_START**0.5, BETA_END**0.5, NUM_TRAIN_TIMESTEPS, dtype=torch.float64).square()
    return (1 - betas).cumprod(0)


def add_noise(latents: Float[Tensor, "*b"], noise: Float[Tensor, "*b"], timestep: int) -> Float[Tensor, "*b"]:
    """Add noise of a timestep to clean latents."""
    alpha = float(alphas_cumprod()[timestep])
    return alpha**0.5 * latents + (1 - alpha) ** 0.5 * noise


def ddim_timesteps(num_inference_steps: int) -> tuple[int, ...]:
    """Return evenly spaced timesteps in descending order: 981, 961, ..., 1 for 50 steps, to be followed by 0.

    They are those of diffusers ("leading", offset 1) where these start at 901 or above. Where the rounded stride or a
    small number of steps would start below (667 for 334 steps, 1 for one step), the first is 901.

    Args:
        num_inference_steps: number of timesteps, 1 to 999.
    """
    stride = NUM_TRAIN_TIMESTEPS // num_inference_steps
    first = max(LOWEST_FIRST_TIMESTEP, stride * (num_inference_steps - 1) + 1)
    return tuple(torch.linspace(first, 1, num_inference_steps, dtype=torch.float64).round().int().tolist())


def ddim_step(
    noisy: Float[Tensor, "*b"], noise_pred: Float[Tensor, "*b"], timestep: int, next_timestep: int
) -> Float[Tensor, "*b"]:
    """Denoise latents from one timestep to the next, given the predicted noise."""
    alpha = float(alphas_cumprod()[timestep])
    clean = (noisy - (1 - alpha) ** 0.5 * noise_pred) / alpha**0.5
    return add_noise(clean, noise_pred, next_timestep)


def read_schedule(model: Path) -> BetaSchedule:
    """Read the noise schedule of `model`/scheduler.

    Raises:
        BadInput: the file is missing or no scheduler configuration.
    """
    file = model / "scheduler" / "scheduler_config.json"
    try:
        config = json.loads(file.read_text(encoding="utf-8"))
        return BetaSchedule(
            beta_start=float(config["beta_start"]),
            beta_end=float(config["beta_end"]),
            beta_schedule=str(config["beta_schedule"]),
            num_train_timesteps=int(config["num_train_timesteps"]),
            prediction_type=str(config.get("prediction_type", "epsilon")),
            trained_betas=config.get("trained_betas") is not None,
            rescale_betas_zero_snr=bool(config.get("rescale_betas_zero_snr", False)),
        )
    except FileNotFoundError as error:
        raise BadInput(f"{file} is missing; give weights in the layout of diffusers") from error
    except (ValueError, KeyError, TypeError) as error:
        raise BadInput(f"{file} is not a scheduler configuration of diffusers: {error!r}") from error


def require_schedule(model: Path, expected: BetaSchedule) -> None:
    """Refuse a model whose noise schedule or prediction type is not the expected one.

    Raises:
        BadInput: the schedules differ.
    """
    given = read_schedule(model)
    betas = ((given.beta_start, expected.beta_start), (given.beta_end, expected.beta_end))
    same = all(math.isclose(ours, theirs, rel_tol=1e-6) for ours, theirs in betas)
    kept = replace(given, beta_start=expected.beta_start, beta_end=expected.beta_end)
    if not same or kept != expected:
        raise BadInput(f"the scheduler of {model} is {given}; expected {expected}")
