"""Stable Diffusion's noise schedule: scaled-linear betas over 1,000 training timesteps."""

from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

TRAIN_STEPS = 1000
BETA_START, BETA_END = 0.00085, 0.012  # scaled-linear, Stable Diffusion v1


@cache
def alphabars() -> Float[Tensor, " steps"]:
    """Return the products of 1 - beta, float64, one per training timestep."""
    betas = torch.linspace(BETA_START**0.5, BETA_END**0.5, TRAIN_STEPS, dtype=torch.float64).square()
    return (1 - betas).cumprod(0)
