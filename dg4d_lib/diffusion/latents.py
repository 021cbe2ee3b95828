"""Encoding and decoding of images with Stable Diffusion's VAE."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.images import resize_planes

SIZE, LATENT_SIZE, LATENT_CHANNELS = 256, 32, 4  # pixels and latents per side, of Zero-1-to-3 and ImageDream


def encode_images(vae: Any, images: Float[Tensor, "b h w 3"]) -> Float[Tensor, "b 4 32 32"]:
    """Encode images in [0, 1] to the unscaled mode of their latents, in the images' precision; differentiable."""
    planes = resize_planes(images.permute(0, 3, 1, 2), (SIZE, SIZE))
    return vae.encode((2 * planes - 1).to(vae.dtype)).latent_dist.mode().to(images.dtype)


def decode_images(vae: Any, latents: Float[Tensor, "b c i j"], dtype: torch.dtype) -> Float[Tensor, "b h w 3"]:
    """Decode unscaled latents, in the precision of the VAE, to images in [0, 1]."""
    return to_images(vae.decode(latents).sample.to(dtype))


def to_images(planes: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b h w 3"]:
    """Convert the VAE's range [-1, 1], channels first, to images in [0, 1], channels last.

    Raises:
        BadInput: values are not finite.
    """
    if not planes.isfinite().all():
        raise BadInput(
            "the diffusion model overflowed: its images are not finite; set its precision to bf16 or fp32 "
            "(--set driving.model.precision=bf16 for a driving video; refiner.model.precision or "
            "refiner.prior.precision for textures; static.start.precision for the views of LGM)"
        )
    return (planes.movedim(1, -1) / 2 + 0.5).clamp(0, 1)


def at_least_float32(dtype: torch.dtype) -> torch.dtype:
    """Return float32 for half precision, else the given type."""
    return torch.promote_types(dtype, torch.float32)
