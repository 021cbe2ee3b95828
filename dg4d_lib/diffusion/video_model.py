"""Stable Video Diffusion in its parts: condition on a picture, encode, denoise and decode videos.

The schedule is Karras et al. 2022; the network predicts v (Salimans and Ho 2022) of x = x0 + sigma e:
x0 = x / (1 + sigma^2) - v sigma / sqrt(1 + sigma^2), and its input is x / sqrt(1 + sigma^2) at the time ln(sigma) / 4.
Between noise levels goes one step of Euler's method. Latents are kept in float32 or better between the steps.
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

GIB = 2**30
OUTSIDE_GB = 1.5  # renders, and what CUDA takes
# per byte of a number, million pixels and frame: what the tensors of the published networks take, and a tenth
ENCODER_GB, DECODER_GB, UNET_GB = 0.66, 1.05, 0.15


def karras_sigmas(steps: int) -> tuple[float, ...]:
    """Return `steps` noise levels from 700 to 0.002 whose 1/7th powers are evenly spaced, and a final 0."""
    top, bottom = SIGMA_MAX ** (1 / RHO), SIGMA_MIN ** (1 / RHO)
    return (*((top + i / (steps - 1) * (bottom - top)) ** RHO for i in range(steps)), 0.0)


def start_index(steps: int, strength: float) -> int:
    """Return the first noise level if only this share of them is used: 0.3 of 25 gives 17, whose sigma is 1.2732."""
    return min(int(steps * (1 - strength) + 1e-9), steps - 1)


def pred_original_sample(
    noisy: Float[Tensor, "*b"], velocity: Float[Tensor, "*b"], sigma: float
) -> Float[Tensor, "*b"]:
    """Return x0 from x and the network's v."""
    return noisy / (1 + sigma**2) - velocity * sigma / math.sqrt(1 + sigma**2)


@dataclass(frozen=True)
class VideoCondition:
    """Conditioning of b videos.

    Attributes:
        embedding: of the picture, by the image encoder.
        latents: of the picture with a little noise, by the VAE, not scaled; every frame gets them.
        ids: fps id, motion bucket and strength of that noise.
    """

    embedding: Float[Tensor, "b 1 d"]
    latents: Float[Tensor, "b c i j"]
    ids: Float[Tensor, "b 3"]


class VideoModel:
    """The three networks, frozen.

    Attributes:
        unet: predicts v.
        vae: pictures to latents and back.
        image_encoder: CLIP.
    """

    def __init__(
        self, unet: Any, vae: Any, image_encoder: Any, settings: VideoModelSettings, device: torch.device
    ) -> None:
        """Take networks; with `settings.low_memory` each is on the device only while it works.

        An encoder that overflows in half precision becomes float32 once and for all; the decoder stays as it is.
        """
        if vae.config.force_upcast and vae.dtype == torch.float16:
            for part in (vae.encoder, vae.quant_conv):
                part.to(torch.float32)
        self.unet, self.vae, self.image_encoder = unet, vae, image_encoder
        self.settings, self.device = settings, device
        weights = [sum(value.nbytes for value in part.parameters()) / GIB for part in (unet, vae, image_encoder)]
        self._spare_gb = settings.memory_gb - OUTSIDE_GB - (max(weights) if settings.low_memory else sum(weights))
        self._videos = MicroBatches("videos of the video model", settings.videos_at_once)
        self._frames = MicroBatches("frames of the video model", settings.decode_chunk_size)
        if not settings.low_memory:
            for part in (unet, vae, image_encoder):
                part.to(device)

    @classmethod
    def load(cls, folder: Path, settings: VideoModelSettings, device: torch.device) -> "VideoModel":
        """Read the networks from a folder in the diffusers layout.

        Raises:
            BadInput: a file is missing, damaged, or holds other tensors than its config says.
            BackendUnavailable: diffusers or transformers is not installed.
        """
        dtype = compute_dtype(device, settings.precision)
        place = Placement(torch.device("cpu") if settings.low_memory else device, dtype)
        unet = shorten_attention(load_temporal_unet(folder, place))
        vae, image_encoder = load_temporal_vae(folder, place), load_image_encoder(folder, place)
        return cls(unet, vae, image_encoder, settings, device)

    def notes(self) -> tuple[str, ...]:
        """Sentences for the report: where memory ran out."""
        return (*self._videos.notes(), *self._frames.notes())

    @property
    def vae_scale_factor(self) -> int:
        """Pixels of a side of a latent: 8."""
        return int(2 ** (len(self.vae.config.block_out_channels) - 1))

    @property
    def num_frames(self) -> int:
        """Frames of the videos that the network was trained on: 14 or 25."""
        return int(self.unet.config.num_frames)

    def latent_shape(self, videos: int, frames: int, height: int, width: int) -> tuple[int, int, int, int, int]:
        """The shape of the latents of videos of this many pixels: "b t c i j"."""
        channels = int(self.vae.config.latent_channels)
        return videos, frames, channels, height // self.vae_scale_factor, width // self.vae_scale_factor

    @torch.no_grad()
    def encode_condition(
        self, picture: Float[Tensor, "h w 3"], generators: Sequence[torch.Generator]
    ) -> VideoCondition:
        """Return the conditioning of videos of this picture, one per generator.

        Args:
            picture: in [0, 1]; sides are multiples of `vae_scale_factor`.
            generators: of the noise on the picture.
        """
        settings, count = self.settings, len(generators)
        scaled = 2 * picture.movedim(-1, 0)[None] - 1
        with self._awake(self.image_encoder) as encoder:
            eye = svd_clip_pixels(scaled.to(self.device, at_least_float32(encoder.dtype)))
            embedding = encoder(eye.to(encoder.dtype)).image_embeds[:, None]
        noise = torch.cat([_normal(scaled.shape, generator, scaled.dtype) for generator in generators])
        latents = self._mode(scaled + settings.noise_aug_strength * noise.to(scaled))
        ids = torch.tensor(
            [settings.fps_id, settings.motion_bucket_id, settings.noise_aug_strength], dtype=self.unet.dtype
        )
        return VideoCondition(embedding.expand(count, -1, -1), latents, ids.to(self.device).expand(count, -1))

    @torch.no_grad()
    def encode(self, video: Float[Tensor, "t h w 3"]) -> Float[Tensor, "t c i j"]:
        """Return the scaled modes of the latents of images in [0, 1]."""
        return self._mode(2 * video.movedim(-1, 1) - 1) * float(self.vae.config.scaling_factor)

    @torch.no_grad()
    def decode(self, latents: Float[Tensor, "t c i j"]) -> Float[Tensor, "t h w 3"]:
        """Decode scaled latents to images in [0, 1], a few frames at a time."""
        with self._awake(self.vae) as vae:
            inside = (latents / vae.config.scaling_factor).to(self.device, _dtype(vae.decoder))
            pictures = self._frames.run(
                lambda part: vae.decode(inside[part], num_frames=len(inside[part])).sample,
                len(inside),
                self._room(DECODER_GB, inside, self.vae_scale_factor),
            )
        decoded = torch.cat(pictures)
        return to_images(decoded.to(at_least_float32(decoded.dtype)))

    @torch.no_grad()
    def denoise(
        self, latents: Float[Tensor, "b t c i j"], condition: VideoCondition, sigmas: Sequence[float]
    ) -> Float[Tensor, "b t c i j"]:
        """Denoise latents from the first noise level to the last by Euler's method.

        Guidance goes from `min_guidance_scale` in the first frame to `max_guidance_scale` in the last; the
        unconditional half knows no picture.
        """
        with self._awake(self.unet) as unet:
            for sigma, following in pairwise(sigmas):
                slope = (
                    latents - pred_original_sample(latents, self._guided(unet, latents, condition, sigma), sigma)
                ) / sigma
                latents = latents + (following - sigma) * slope
        return latents

    def sample_noise(self, shape: Sequence[int], generators: Sequence[torch.Generator]) -> Float[Tensor, "b t c i j"]:
        """Draw standard normal noise for the latents of several videos, one generator each."""
        dtype = at_least_float32(self.unet.dtype)
        return torch.cat([_normal((1, *shape[1:]), generator, dtype) for generator in generators]).to(self.device)

    def _guided(
        self, unet: Any, latents: Float[Tensor, "b t c i j"], condition: VideoCondition, sigma: float
    ) -> Float[Tensor, "b t c i j"]:
        """The network's v, guided towards the picture."""
        frames = latents.shape[1]
        time = torch.tensor(0.25 * math.log(sigma), dtype=at_least_float32(unet.dtype), device=self.device)
        embedding = torch.cat([torch.zeros_like(condition.embedding), condition.embedding])
        pictures = torch.cat([torch.zeros_like(condition.latents), condition.latents])
        ids = torch.cat([condition.ids, condition.ids])
        noisy = (torch.cat([latents, latents]) / math.sqrt(1 + sigma**2)).to(unet.dtype)
        seen = torch.cat([noisy, pictures[:, None].expand(-1, frames, -1, -1, -1).to(unet.dtype)], 2)
        velocities = self._videos.run(
            lambda part: unet(seen[part], time, embedding[part], ids[part], return_dict=False)[0],
            len(seen),
            self._room(frames * UNET_GB, seen, self.vae_scale_factor),
        )
        without, informed = torch.cat(velocities).to(latents).chunk(2)
        guidance = torch.linspace(self.settings.min_guidance_scale, self.settings.max_guidance_scale, frames)
        return without + guidance.to(latents)[:, None, None, None] * (informed - without)

    def _mode(self, pictures: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b c i j"]:
        """Latents of pictures in [-1, 1]."""
        with self._awake(self.vae) as vae:
            seen = pictures.to(self.device, _dtype(vae.encoder))
            latents = self._frames.run(
                lambda part: vae.encode(seen[part]).latent_dist.mode(), len(seen), self._room(ENCODER_GB, seen)
            )
        modes = torch.cat(latents)
        return modes.to(at_least_float32(modes.dtype))

    def _room(self, gb: float, inputs: Float[Tensor, "b *shape h w"], enlarged: int = 1) -> int:
        """For how many inputs at a time the budget has room.

        Args:
            gb: GiB per byte of a number and million pixels.
            inputs: of a network, as it computes.
            enlarged: pixels of a side of the picture per number of the input.
        """
        pixels = inputs.shape[-2] * inputs.shape[-1] * enlarged**2
        return max(1, int(self._spare_gb / (gb * inputs.dtype.itemsize * pixels / 1e6)))

    @contextmanager
    def _awake(self, part: Any) -> Iterator[Any]:
        if not self.settings.low_memory:
            yield part
            return
        part.to(self.device)
        try:
            yield part
        finally:
            part.to("cpu")


def _dtype(part: nn.Module) -> torch.dtype:
    """What a part of a network computes in."""
    return next(part.parameters()).dtype


def _normal(shape: Sequence[int], generator: torch.Generator, dtype: torch.dtype) -> Tensor:
    """Drawn where the generator is, so that devices agree."""
    return torch.randn(tuple(shape), generator=generator, dtype=dtype, device=generator.device)
