"""Stable Diffusion's noise schedule, and the DDIM sampler without fresh noise (Song et al. 2021)."""

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


@dataclass(frozen=True)
class BetaSchedule:
    """Noise schedule and prediction type of a model, with the values of diffusers."""

    beta_start: float
    beta_end: float
    beta_schedule: str
    num_train_timesteps: int
    prediction_type: str


SCHEDULE = BetaSchedule(BETA_START, BETA_END, "scaled_linear", NUM_TRAIN_TIMESTEPS, "epsilon")


@cache
def alphas_cumprod() -> Float[Tensor, " steps"]:
    """Return the products of 1 - beta, float64, one per training timestep."""
    betas = torch.linspace(BETA_START**0.5, BETA_END**0.5, NUM_TRAIN_TIMESTEPS, dtype=torch.float64).square()
    return (1 - betas).cumprod(0)


def add_noise(latents: Float[Tensor, "*b"], noise: Float[Tensor, "*b"], timestep: int) -> Float[Tensor, "*b"]:
    """Return clean latents with the noise of a timestep."""
    alpha = float(alphas_cumprod()[timestep])
    return alpha**0.5 * latents + (1 - alpha) ** 0.5 * noise


def ddim_timesteps(num_inference_steps: int) -> tuple[int, ...]:
    """Return evenly spaced timesteps from the noisiest to the cleanest: 981, 961, ..., 1 for 50 steps; 0 follows."""
    stride = NUM_TRAIN_TIMESTEPS // num_inference_steps
    return tuple(stride * i + 1 for i in reversed(range(num_inference_steps)))


def ddim_step(
    noisy: Float[Tensor, "*b"], noise_pred: Float[Tensor, "*b"], timestep: int, next_timestep: int
) -> Float[Tensor, "*b"]:
    """Denoise latents from one timestep to the next, given the noise that the network predicts."""
    alpha = float(alphas_cumprod()[timestep])
    clean = (noisy - (1 - alpha) ** 0.5 * noise_pred) / alpha**0.5
    return add_noise(clean, noise_pred, next_timestep)


def read_schedule(model: Path) -> BetaSchedule:
    """Read the noise schedule of `model`/scheduler.

    Raises:
        BadInput: there is no such file, or it is no scheduler's.
    """
    file = model / "scheduler" / "scheduler_config.json"
    try:
        about = json.loads(file.read_text(encoding="utf-8"))
        return BetaSchedule(
            beta_start=float(about["beta_start"]),
            beta_end=float(about["beta_end"]),
            beta_schedule=str(about["beta_schedule"]),
            num_train_timesteps=int(about["num_train_timesteps"]),
            prediction_type=str(about.get("prediction_type", "epsilon")),
        )
    except FileNotFoundError as error:
        raise BadInput(f"{file} is missing; weights are expected in the layout of diffusers") from error
    except (ValueError, KeyError, TypeError) as error:
        raise BadInput(f"{file} is no scheduler of diffusion models: {error!r}") from error


def require_schedule(model: Path, expected: BetaSchedule) -> None:
    """Refuse a model whose noise schedule or prediction type is not the expected one.

    Raises:
        BadInput: says what differs.
    """
    given = read_schedule(model)
    betas = ((given.beta_start, expected.beta_start), (given.beta_end, expected.beta_end))
    same = all(math.isclose(ours, theirs, rel_tol=1e-6) for ours, theirs in betas)
    kept = replace(given, beta_start=expected.beta_start, beta_end=expected.beta_end)
    if not same or kept != expected:
        raise BadInput(f"the scheduler of {model} is {given}; this model has to have {expected}")
