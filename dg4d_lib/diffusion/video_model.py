"""Stable Video Diffusion: image conditioning, encoding, denoising and decoding of videos.

The noise levels are those of Karras et al. 2022; the network predicts v (Salimans and Ho 2022) of x = x0 + sigma e:
x0 = x / (1 + sigma^2) - v sigma / sqrt(1 + sigma^2), with input x / sqrt(1 + sigma^2) and timestep ln(sigma) / 4. The
sampler is Euler's method. Latents are kept in at least float32 between the steps.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from dg4d_lib.diffusion.batching import MicroBatches
from dg4d_lib.diffusion.clip_images import svd_clip_pixels
from dg4d_lib.diffusion.components import (
    Placement,
    compute_dtype,
    load_image_encoder,
    load_temporal_unet,
    load_temporal_vae,
)
from dg4d_lib.diffusion.latents import at_least_float32, to_images
from dg4d_lib.diffusion.single_token_attention import shorten_attention
from dg4d_lib.settings import VideoModelSettings

SIGMA_MAX, SIGMA_MIN, RHO = 700.0, 0.002, 7.0

GIB = 2**30  # bytes
OVERHEAD_GB = 1.5  # renders and the CUDA context
# GiB per byte of the dtype, megapixel and frame: measured tensors of the published networks plus 10 %
ENCODER_GB, DECODER_GB, UNET_GB = 0.8, 1.05, 0.15


def karras_sigmas(steps: int) -> tuple[float, ...]:
    """Return `steps` noise levels from 700 to 0.002 whose 1/7th powers are evenly spaced, and a final 0."""
    top, bottom = SIGMA_MAX ** (1 / RHO), SIGMA_MIN ** (1 / RHO)
    return (*((top + i / max(1, steps - 1) * (bottom - top)) ** RHO for i in range(steps)), 0.0)


def start_index(steps: int, strength: float) -> int:
    """Return the index of the first noise level for a strength: 0.3 of 25 gives 17, whose sigma is 1.2732."""
    return min(int(steps * (1 - strength) + 1e-9), steps - 1)


def pred_original_sample(
    noisy: Float[Tensor, "*b"], velocity: Float[Tensor, "*b"], sigma: float
) -> Float[Tensor, "*b"]:
    """Return x0, given x and the predicted v."""
    return noisy / (1 + sigma**2) - velocity * sigma / math.sqrt(1 + sigma**2)


@dataclass(frozen=True)
class VideoCondition:
    """Image conditioning of b videos.

    Attributes:
        embedding: of the image, by the image encoder.
        latents: of the image with noise augmentation, by the VAE, unscaled; concatenated to every frame.
        ids: fps id, motion bucket id and noise augmentation strength (diffusers' added_time_ids).
    """

    embedding: Float[Tensor, "b 1 d"]
    latents: Float[Tensor, "b c i j"]
    ids: Float[Tensor, "b 3"]


class VideoModel:
    """Frozen networks of Stable Video Diffusion.

    Attributes:
        unet: UNetSpatioTemporalConditionModel, predicts v.
        vae: AutoencoderKLTemporalDecoder.
        image_encoder: CLIPVisionModelWithProjection.
    """

    def __init__(
        self, unet: Any, vae: Any, image_encoder: Any, settings: VideoModelSettings, device: torch.device
    ) -> None:
        """Place the networks; with `settings.low_memory` each is on the device only while in use.

        A VAE encoder with `force_upcast` overflows in half precision and is converted to float32; the decoder is not.
        """
        if vae.config.force_upcast and vae.dtype == torch.float16:
            for part in (vae.encoder, vae.quant_conv):
                part.to(torch.float32)
        self.unet, self.vae, self.image_encoder = unet, vae, image_encoder
        self.settings, self.device = settings, device
        weights = [sum(value.nbytes for value in part.parameters()) / GIB for part in (unet, vae, image_encoder)]
        self._spare_gb = settings.memory_gb - OVERHEAD_GB - (max(weights) if settings.low_memory else sum(weights))
        self._videos = MicroBatches("videos of the video model", settings.videos_at_once)
        self._frames = MicroBatches("frames of the video model", settings.decode_chunk_size)
        if not settings.low_memory:
            for part in (unet, vae, image_encoder):
                part.to(device)

    @classmethod
    def load(cls, folder: Path, settings: VideoModelSettings, device: torch.device) -> "VideoModel":
        """Read the networks from a folder in the diffusers layout.

        Raises:
            BadInput: a file is missing, damaged, or does not match its config.json.
            BackendUnavailable: diffusers or transformers is not installed.
        """
        dtype = compute_dtype(device, settings.precision)
        place = Placement(torch.device("cpu") if settings.low_memory else device, dtype)
        unet = shorten_attention(load_temporal_unet(folder, place))
        vae, image_encoder = load_temporal_vae(folder, place), load_image_encoder(folder, place)
        return cls(unet, vae, image_encoder, settings, device)

    def notes(self) -> tuple[str, ...]:
        """Return sentences for the report about memory that ran out."""
        return (*self._videos.notes(), *self._frames.notes())

    @property
    def vae_scale_factor(self) -> int:
        """Pixels per latent and side: 8."""
        return int(2 ** (len(self.vae.config.block_out_channels) - 1))

    @property
    def num_frames(self) -> int:
        """Number of frames that the network was trained on: 14 or 25."""
        return int(self.unet.config.num_frames)

    def latent_shape(self, videos: int, frames: int, height: int, width: int) -> tuple[int, int, int, int, int]:
        """Return the shape "b t c i j" of the latents of videos with this many pixels."""
        channels = int(self.vae.config.latent_channels)
        return videos, frames, channels, height // self.vae_scale_factor, width // self.vae_scale_factor

    @torch.no_grad()
    def encode_condition(self, image: Float[Tensor, "h w 3"], generators: Sequence[torch.Generator]) -> VideoCondition:
        """Return the conditioning on an image for one video per generator.

        Args:
            image: in [0, 1]; sides are multiples of `vae_scale_factor`.
            generators: of the noise augmentation.
        """
        settings, count = self.settings, len(generators)
        scaled = 2 * image.movedim(-1, 0)[None] - 1
        with self._on_device(self.image_encoder) as encoder:
            pixels = svd_clip_pixels(scaled.to(self.device, at_least_float32(encoder.dtype)))
            embedding = encoder(pixels.to(encoder.dtype)).image_embeds[:, None]
        noise = torch.cat([_normal(scaled.shape, generator, scaled.dtype) for generator in generators])
        latents = self._mode(scaled + settings.noise_aug_strength * noise.to(scaled))
        ids = torch.tensor(
            [settings.fps_id, settings.motion_bucket_id, settings.noise_aug_strength], dtype=self.unet.dtype
        )
        return VideoCondition(embedding.expand(count, -1, -1), latents, ids.to(self.device).expand(count, -1))

    @torch.no_grad()
    def encode(self, video: Float[Tensor, "t h w 3"]) -> Float[Tensor, "t c i j"]:
        """Encode images in [0, 1] to the scaled modes of their latents."""
        return self._mode(2 * video.movedim(-1, 1) - 1) * float(self.vae.config.scaling_factor)

    @torch.no_grad()
    def decode(self, latents: Float[Tensor, "t c i j"]) -> Float[Tensor, "t h w 3"]:
        """Decode scaled latents to images in [0, 1], `decode_chunk_size` frames at a time."""
        with self._on_device(self.vae) as vae:
            unscaled = (latents / vae.config.scaling_factor).to(self.device, _dtype(vae.decoder))
            images = self._frames.run(
                lambda part: vae.decode(unscaled[part], num_frames=len(unscaled[part])).sample,
                len(unscaled),
                self._max_batch(DECODER_GB, unscaled, self.vae_scale_factor),
            )
        decoded = torch.cat(images)
        return to_images(decoded.to(at_least_float32(decoded.dtype)))

    @torch.no_grad()
    def denoise(
        self, latents: Float[Tensor, "b t c i j"], condition: VideoCondition, sigmas: Sequence[float]
    ) -> Float[Tensor, "b t c i j"]:
        """Denoise latents from the first noise level to the last by Euler's method.

        The guidance scale increases linearly from `min_guidance_scale` in the first frame to `max_guidance_scale` in
        the last; the unconditional half has zero image conditioning.
        """
        with self._on_device(self.unet) as unet:
            for sigma, following in pairwise(sigmas):
                slope = (
                    latents - pred_original_sample(latents, self._guided(unet, latents, condition, sigma), sigma)
                ) / sigma
                latents = latents + (following - sigma) * slope
        return latents

    def sample_noise(self, shape: Sequence[int], generators: Sequence[torch.Generator]) -> Float[Tensor, "b t c i j"]:
        """Draw standard normal latents of several videos, one generator each."""
        dtype = at_least_float32(self.unet.dtype)
        return torch.cat([_normal((1, *shape[1:]), generator, dtype) for generator in generators]).to(self.device)

    def _guided(
        self, unet: Any, latents: Float[Tensor, "b t c i j"], condition: VideoCondition, sigma: float
    ) -> Float[Tensor, "b t c i j"]:
        """Predict v with classifier-free guidance."""
        frames = latents.shape[1]
        timestep = torch.tensor(0.25 * math.log(sigma), dtype=at_least_float32(unet.dtype), device=self.device)
        embedding = torch.cat([torch.zeros_like(condition.embedding), condition.embedding])
        image_latents = torch.cat([torch.zeros_like(condition.latents), condition.latents])
        ids = torch.cat([condition.ids, condition.ids])
        noisy = (torch.cat([latents, latents]) / math.sqrt(1 + sigma**2)).to(unet.dtype)
        inputs = torch.cat([noisy, image_latents[:, None].expand(-1, frames, -1, -1, -1).to(unet.dtype)], 2)
        velocities = self._videos.run(
            lambda part: unet(inputs[part], timestep, embedding[part], ids[part], return_dict=False)[0],
            len(inputs),
            self._max_batch(frames * UNET_GB, inputs, self.vae_scale_factor),
        )
        unconditional, conditional = torch.cat(velocities).to(latents).chunk(2)
        guidance_scale = torch.linspace(self.settings.min_guidance_scale, self.settings.max_guidance_scale, frames)
        return unconditional + guidance_scale.to(latents)[:, None, None, None] * (conditional - unconditional)

    def _mode(self, images: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b c i j"]:
        """Return the unscaled latents of images in [-1, 1]."""
        with self._on_device(self.vae) as vae:
            inputs = images.to(self.device, _dtype(vae.encoder))
            latents = self._frames.run(
                lambda part: vae.encode(inputs[part]).latent_dist.mode(),
                len(inputs),
                self._max_batch(ENCODER_GB, inputs),
            )
        modes = torch.cat(latents)
        return modes.to(at_least_float32(modes.dtype))

    def _max_batch(self, gb: float, inputs: Float[Tensor, "b *shape h w"], scale_factor: int = 1) -> int:
        """Return the number of inputs that fit into the memory budget at once, at least one.

        Args:
            gb: GiB per byte of the dtype and megapixel.
            inputs: of the network, in its dtype.
            scale_factor: image pixels per side of an element of the input.
        """
        pixels = inputs.shape[-2] * inputs.shape[-1] * scale_factor**2
        return max(1, int(self._spare_gb / (gb * inputs.dtype.itemsize * pixels / 1e6)))

    @contextmanager
    def _on_device(self, part: Any) -> Iterator[Any]:
        if not self.settings.low_memory:
            yield part
            return
        part.to(self.device)
        try:
            yield part
        finally:
            part.to("cpu")


def _dtype(part: nn.Module) -> torch.dtype:
    """Return the dtype of a network's parameters."""
    return next(part.parameters()).dtype


def _normal(shape: Sequence[int], generator: torch.Generator, dtype: torch.dtype) -> Tensor:
    """Draw normal noise on the generator's device, so that all devices get the same noise."""
    return torch.randn(tuple(shape), generator=generator, dtype=dtype, device=generator.device)
