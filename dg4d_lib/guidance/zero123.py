"""Zero-1-to-3 as a guidance prior: novel views of an image, conditioned on a relative camera pose (Liu et al. 2023).

Loading is slow and done once; conditioning on frames is quick and returns a new frozen prior. The folder has the layout
of `dg4d_lib/diffusion/components.py` and clip_camera_projection/, which holds the linear layer `proj` from [CLIP
embedding, relative pose] to the single token of the UNet's cross-attention.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.devices import to_device_async
from dg4d_lib.diffusion.batching import MicroBatches
from dg4d_lib.diffusion.clip_images import clip_pixels
from dg4d_lib.diffusion.components import (
    Placement,
    compute_dtype,
    load_image_encoder,
    load_unet,
    load_vae,
    read_linear,
)
from dg4d_lib.diffusion.latents import LATENT_CHANNELS, LATENT_SIZE, SIZE, encode_images
from dg4d_lib.diffusion.noise_schedule import SCHEDULE, require_schedule
from dg4d_lib.diffusion.single_token_attention import shorten_attention
from dg4d_lib.errors import BadInput
from dg4d_lib.guidance.distillation import TimestepSchedule, distill_in_pieces
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.settings import Precision, Zero123PriorSettings

CAMERA_NUMBERS = 4

RESIDENT_GB = {"fp16": 5.0, "bf16": 5.0, "fp32": 8.0}  # weights (2.7 or 5.4), renders and what CUDA takes
VIEW_GB = {"fp16": 0.5, "bf16": 0.5, "fp32": 1.0}  # what the VAE keeps for its gradient (.37 or .74), and workspace


@dataclass(frozen=True)
class Zero123:
    """The frozen networks.

    Attributes:
        vae: AutoencoderKL.
        unet: UNet2DConditionModel: noisy latent and the input's latent in, noise out.
        image_encoder: CLIPVisionModelWithProjection.
        camera_projection: CLIP embedding and camera to one token.
        settings: of the prior.
    """

    vae: Any
    unet: Any
    image_encoder: Any
    camera_projection: nn.Linear
    settings: Zero123PriorSettings

    @classmethod
    def load(cls, model: Path, settings: Zero123PriorSettings, device: torch.device) -> "Zero123":
        """Read the networks from a folder.

        Args:
            model: in diffusers' layout.
            settings: precision, memory and guidance.
            device: where they will run; on a processor in fp32 whatever the settings say.

        Raises:
            BadInput: a file is missing or damaged, or the parts are not those of Zero-1-to-3.
            BackendUnavailable: diffusers is not installed.
        """
        placement = Placement(device, compute_dtype(device, settings.precision), channels_last=device.type == "cuda")
        require_schedule(model, SCHEDULE)
        projection = read_linear(model / "clip_camera_projection", "proj", placement)
        encoder = load_image_encoder(model, placement)
        vae, unet = load_vae(model, placement), shorten_attention(load_unet(model, placement))
        found = {
            "inputs of the UNet": (unet.config.in_channels, 2 * LATENT_CHANNELS),
            "outputs of the UNet": (unet.config.out_channels, LATENT_CHANNELS),
            "channels of the VAE": (vae.config.latent_channels, LATENT_CHANNELS),
            "shrinking by the VAE": (2 ** (len(vae.config.block_out_channels) - 1), SIZE // LATENT_SIZE),
            "inputs of the projection": (projection.in_features, encoder.config.projection_dim + CAMERA_NUMBERS),
            "outputs of the projection": (projection.out_features, unet.config.cross_attention_dim),
        }
        if wrong := [f"{name}: {have} instead of {want}" for name, (have, want) in found.items() if have != want]:
            raise BadInput(f"{model} is no Zero-1-to-3 ({'; '.join(wrong)}); give weights of Zero-1-to-3")
        if settings.compiled:
            unet.compile()
            vae.encoder.compile()
        return cls(vae, unet, encoder, projection, settings)

    @torch.no_grad()
    def conditioned_on(
        self, frames: Float[Tensor, "t h w 3"], noise: TimestepSchedule, input_camera: OrbitCamera | None = None
    ) -> "ConditionedZero123":
        """A prior that knows these frames; the image encoder is not part of it and may be freed.

        Args:
            frames: what the input camera sees, over white, in [0, 1].
            noise: which timestep an iteration uses.
            input_camera: where the frames were taken from; the default is azimuth and elevation 0.
        """
        precision: Precision = self.settings.precision
        batches = MicroBatches.within(
            "views for the prior", self.settings.memory_gb, RESIDENT_GB[precision], VIEW_GB[precision]
        )

        def embed(piece: slice) -> tuple[Tensor, Tensor]:
            pictures = frames[piece].to(self.vae.device)
            clip = clip_pixels(pictures).to(self.image_encoder.dtype)
            return self.image_encoder(clip).image_embeds, encode_images(self.vae, pictures).to(self.unet.dtype)

        embeddings, latents = (torch.cat(parts) for parts in zip(*batches.run(embed, len(frames)), strict=True))
        return ConditionedZero123(
            vae=self.vae,
            unet=self.unet,
            camera_projection=self.camera_projection,
            settings=self.settings,
            embeddings=embeddings,
            latents=latents,
            noise=noise,
            input_camera=input_camera or OrbitCamera(),
            batches=batches,
        )


@dataclass(frozen=True)
class ConditionedZero123:
    """A guidance prior: every render is judged as another view of its frame.

    Attributes:
        vae: as in `Zero123`.
        unet: as in `Zero123`.
        camera_projection: as in `Zero123`.
        settings: of the prior.
        embeddings: CLIP's, of every frame.
        latents: the VAE's, of every frame, not scaled.
        noise: which timestep an iteration uses.
        input_camera: where the frames were taken from.
        batches: how many views are judged at once.
    """

    vae: Any
    unet: Any
    camera_projection: nn.Linear
    settings: Zero123PriorSettings
    embeddings: Float[Tensor, "t e"]
    latents: Float[Tensor, "t 4 32 32"]
    noise: TimestepSchedule
    input_camera: OrbitCamera
    batches: MicroBatches
    viewpoints: tuple[OrbitCamera, ...] | None = field(default=None, init=False)
    frames: tuple[int, ...] | None = field(default=None, init=False)

    def loss(
        self,
        images: Float[Tensor, "b h w 3"],
        coverage: Float[Tensor, "b h w 1"],
        views: Sequence[GuidanceView],
        progress: float,
        generator: torch.Generator,
    ) -> Float[Tensor, ""]:
        """The distillation loss of the renders; coverage is ignored.

        Raises:
            BadInput: a view of a frame that it does not know.
            BackendUnavailable: there is no memory for a single view.
        """
        timestep = self.noise.timestep(progress, generator)
        shape = (len(images), LATENT_CHANNELS, LATENT_SIZE, LATENT_SIZE)
        noise = to_device_async(torch.randn(shape, dtype=images.dtype, generator=generator), self.vae.device)
        tokens, pictures = self.tokens(views), self.latents[self._rows(views)]

        def encode(pixels: Float[Tensor, "p h w 3"]) -> Float[Tensor, "p 4 32 32"]:
            return self.vae.config.scaling_factor * encode_images(self.vae, pixels.to(self.vae.device))

        def predict_noise(noisy: Float[Tensor, "p 4 32 32"], timestep: int, piece: slice) -> Float[Tensor, "p 4 32 32"]:
            return self.predict_noise(noisy, timestep, pictures[piece], tokens[piece])

        return distill_in_pieces(images, encode, predict_noise, timestep, noise, self.batches)

    def predict_noise(
        self,
        noisy: Float[Tensor, "b 4 32 32"],
        timestep: int,
        pictures: Float[Tensor, "b 4 32 32"],
        tokens: Float[Tensor, "b 1 c"],
    ) -> Float[Tensor, "b 4 32 32"]:
        """The UNet's noise with classifier-free guidance, in the precision of `noisy`.

        Args:
            noisy: x_t.
            timestep: t.
            pictures: latents of the frames; zero in the unconditional half.
            tokens: of the cameras; zero in the unconditional half.
        """
        context = torch.cat([torch.zeros_like(tokens), tokens])
        condition = torch.cat([torch.zeros_like(pictures), pictures])
        inputs = torch.cat([torch.cat([noisy, noisy]).to(condition.dtype), condition], 1)
        timesteps = torch.full((len(inputs),), timestep, device=inputs.device)
        free, conditional = self.unet(inputs, timesteps, context).sample.to(noisy.dtype).chunk(2)
        return free + self.settings.guidance_scale * (conditional - free)

    def tokens(self, views: Sequence[GuidanceView]) -> Float[Tensor, "b 1 c"]:
        """What the cross-attention of the UNet reads: one token per view, out of its frame and its camera."""
        told = self.settings.input_elevation_deg if self.settings.variant == "stable" else None
        cameras = torch.stack([relative_pose(view.camera, self.input_camera, told) for view in views])
        embeddings = self.embeddings[self._rows(views)]
        with torch.no_grad():
            placed = to_device_async(cameras.to(embeddings.dtype), embeddings.device)
            return self.camera_projection(torch.cat([embeddings, placed], -1))[:, None]

    def _rows(self, views: Sequence[GuidanceView]) -> Int64[Tensor, " b"]:
        """Where the frames of some views stand."""
        known = len(self.embeddings)
        if wrong := [view.frame for view in views if not 0 <= view.frame < known]:
            raise BadInput(f"frame {wrong[0]} was asked for; there are {known}, counted from 0")
        return to_device_async(torch.tensor([view.frame for view in views]), self.embeddings.device)


def relative_pose(
    camera: OrbitCamera, input_camera: OrbitCamera, input_elevation_deg: float | None = None
) -> Float[Tensor, " 4"]:
    """A camera as Zero-1-to-3 was trained to read it, relative to the input's: the one place of its conventions.

    It counts the polar angle from the pole above, so that a camera that moved up, for us a greater elevation, has a
    negative difference; azimuths grow in the same direction as ours.

    Args:
        camera: where the new picture is taken from.
        input_camera: where the known one was taken from.
        input_elevation_deg: for Stable-Zero123, whose last number is the known picture's polar angle; otherwise it is
            the difference of the radii, world units.

    Returns:
        [polar difference in radians, sine and cosine of the azimuth difference, last number], float64.
    """
    polar = math.radians(input_camera.elevation_deg - camera.elevation_deg)
    azimuth = math.radians(camera.azimuth_deg - input_camera.azimuth_deg)
    last = camera.radius - input_camera.radius
    if input_elevation_deg is not None:
        last = math.radians(90 - input_elevation_deg)
    return torch.tensor([polar, math.sin(azimuth), math.cos(azimuth), last], dtype=torch.float64)
