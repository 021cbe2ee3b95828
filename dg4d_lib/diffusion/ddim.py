"""The sampler that adds no new noise on its way (DDIM: Song et al. 2021)."""

from jaxtyping import Float
from torch import Tensor

from dg4d_lib.diffusion.noise_schedule import TRAIN_STEPS, alphas_cumprod


def ddim_timesteps(steps: int) -> tuple[int, ...]:
    """From the noisiest to the cleanest, evenly spaced: 981, 961, ..., 1 for 50 steps. A step to 0 ends the way."""
    stride = TRAIN_STEPS // steps
    return tuple(stride * i + 1 for i in reversed(range(steps)))


def diffused(latents: Float[Tensor, "*b"], noise: Float[Tensor, "*b"], timestep: int) -> Float[Tensor, "*b"]:
    """Clean latents with the noise of a timestep."""
    alphabar = float(alphas_cumprod()[timestep])
    return alphabar**0.5 * latents + (1 - alphabar) ** 0.5 * noise


def ddim_step(
    noisy: Float[Tensor, "*b"], believed: Float[Tensor, "*b"], timestep: int, following: int
) -> Float[Tensor, "*b"]:
    """From one timestep to the next, given the noise that the network believes in."""
    alphabar = float(alphas_cumprod()[timestep])
    clean = (noisy - (1 - alphabar) ** 0.5 * believed) / alphabar**0.5
    return diffused(clean, believed, following)
