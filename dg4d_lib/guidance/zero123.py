"""Zero-1-to-3 as a guidance prior: novel views of an image, conditioned on a relative camera pose (Liu et al. 2023).

Loading is slow and done once; conditioning on frames is quick and returns a new frozen prior. The folder has the layout
of `dg4d_lib/diffusion/components.py` and clip_camera_projection/, which holds the linear layer `proj` from [CLIP
embedding, relative pose] to the single token of the UNet's cross-attention.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

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
from dg4d_lib.guidance.distillation import TimestepSchedule, distill_in_pieces, require_finite_conditioning
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.settings import Precision, Zero123PriorSettings

POSE_DIM = 4  # length of the relative pose

RESIDENT_GB = {"fp16": 5.0, "bf16": 5.0, "fp32": 8.0}  # measured: weights (2.7 or 5.4), renders, CUDA context
VIEW_GB = {"fp16": 0.5, "bf16": 0.5, "fp32": 1.0}  # measured: VAE activations (0.37 or 0.74), workspace


@dataclass(frozen=True)
class Zero123:
    """Frozen networks of Zero-1-to-3.

    Attributes:
        vae: AutoencoderKL.
        unet: UNet2DConditionModel; predicts noise from noisy latents and the input image's latents.
        image_encoder: CLIPVisionModelWithProjection.
        camera_projection: linear layer from CLIP embedding and relative pose to one token.
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
            device: of the networks; CPUs use fp32.

        Raises:
            BadInput: a file is missing or damaged, or the networks are not those of Zero-1-to-3.
            BackendUnavailable: diffusers is not installed.
        """
        placement = Placement(device, compute_dtype(device, settings.precision), channels_last=device.type == "cuda")
        require_schedule(model, SCHEDULE)
        projection = read_linear(model / "clip_camera_projection", "proj", placement)
        encoder = load_image_encoder(model, placement)
        vae, unet = load_vae(model, placement), shorten_attention(load_unet(model, placement))
        sizes = {
            "inputs of the UNet": (unet.config.in_channels, 2 * LATENT_CHANNELS),
            "outputs of the UNet": (unet.config.out_channels, LATENT_CHANNELS),
            "channels of the VAE": (vae.config.latent_channels, LATENT_CHANNELS),
            "scale factor of the VAE": (2 ** (len(vae.config.block_out_channels) - 1), SIZE // LATENT_SIZE),
            "inputs of the projection": (projection.in_features, encoder.config.projection_dim + POSE_DIM),
            "outputs of the projection": (projection.out_features, unet.config.cross_attention_dim),
        }
        if wrong := [f"{name}: {have}, expected {want}" for name, (have, want) in sizes.items() if have != want]:
            raise BadInput(f"{model} holds no Zero-1-to-3 model ({'; '.join(wrong)}); give weights of Zero-1-to-3")
        if settings.compiled:
            unet.compile()
            vae.encoder.compile()
        return cls(vae, unet, encoder, projection, settings)

    @torch.no_grad()
    def conditioned_on(
        self, frames: Float[Tensor, "t h w 3"], schedule: TimestepSchedule, input_camera: OrbitCamera | None = None
    ) -> "ConditionedZero123":
        """Return a prior conditioned on these frames; it does not use the image encoder, which may be freed.

        Args:
            frames: of the input camera, over white, in [0, 1].
            schedule: of the timestep.
            input_camera: camera of the frames; the default is azimuth and elevation 0.

        Raises:
            BadInput: the networks overflow, so that the encoding of a frame is not finite.
        """
        precision: Precision = self.settings.precision
        batches = MicroBatches.within(
            "views for the prior", self.settings.memory_gb, RESIDENT_GB[precision], VIEW_GB[precision]
        )

        def embed(piece: slice) -> tuple[Tensor, Tensor]:
            images = frames[piece].to(self.vae.device)
            pixels = clip_pixels(images).to(self.image_encoder.dtype)
            return self.image_encoder(pixels).image_embeds, encode_images(self.vae, images).to(self.unet.dtype)

        embeddings, latents = (torch.cat(parts) for parts in zip(*batches.run(embed, len(frames)), strict=True))
        require_finite_conditioning(embeddings, latents)
        return ConditionedZero123(
            vae=self.vae,
            unet=self.unet,
            camera_projection=self.camera_projection,
            settings=self.settings,
            embeddings=embeddings,
            latents=latents,
            schedule=schedule,
            input_camera=input_camera or OrbitCamera(),
            batches=batches,
        )


@dataclass(frozen=True)
class ConditionedZero123:
    """Guidance prior that scores every render as a novel view of its frame.

    Attributes:
        vae: as in `Zero123`.
        unet: as in `Zero123`.
        camera_projection: as in `Zero123`.
        settings: of the prior.
        embeddings: CLIP embeddings of the frames.
        latents: unscaled VAE latents of the frames.
        schedule: of the timestep.
        input_camera: camera of the frames.
        batches: micro-batches of views.
    """

    vae: Any
    unet: Any
    camera_projection: nn.Linear
    settings: Zero123PriorSettings
    embeddings: Float[Tensor, "t e"]
    latents: Float[Tensor, "t 4 32 32"]
    schedule: TimestepSchedule
    input_camera: OrbitCamera
    batches: MicroBatches
    viewpoints: tuple[OrbitCamera, ...] | None = field(default=None, init=False)
    frames: tuple[int, ...] | None = field(default=None, init=False)

    def loss(
        self,
        images: Float[Tensor, "b h w 3"],
        alpha: Float[Tensor, "b h w 1"],
        views: Sequence[GuidanceView],
        progress: float,
        generator: torch.Generator,
    ) -> Float[Tensor, ""]:
        """Return the distillation loss of the renders; alpha is ignored.

        Raises:
            BadInput: a view of an unknown frame.
            BackendUnavailable: a single view does not fit into memory.
        """
        timestep = self.schedule.timestep(progress, generator)
        shape = (len(images), LATENT_CHANNELS, LATENT_SIZE, LATENT_SIZE)
        noise = to_device_async(torch.randn(shape, dtype=images.dtype, generator=generator), self.vae.device)
        tokens, image_latents = self.tokens(views), self.latents[self._rows(views)]

        def encode(pixels: Float[Tensor, "p h w 3"]) -> Float[Tensor, "p 4 32 32"]:
            return self.vae.config.scaling_factor * encode_images(self.vae, pixels.to(self.vae.device))

        def predict_noise(noisy: Float[Tensor, "p 4 32 32"], timestep: int, piece: slice) -> Float[Tensor, "p 4 32 32"]:
            return self.predict_noise(noisy, timestep, image_latents[piece], tokens[piece])

        return distill_in_pieces(images, encode, predict_noise, timestep, noise, self.batches)

    def predict_noise(
        self,
        noisy: Float[Tensor, "b 4 32 32"],
        timestep: int,
        image_latents: Float[Tensor, "b 4 32 32"],
        tokens: Float[Tensor, "b 1 c"],
    ) -> Float[Tensor, "b 4 32 32"]:
        """Predict the noise with classifier-free guidance, in the precision of `noisy`.

        Args:
            noisy: x_t.
            timestep: t.
            image_latents: of the frames; zero in the unconditional half.
            tokens: of frames and poses; zero in the unconditional half.
        """
        context = torch.cat([torch.zeros_like(tokens), tokens])
        condition = torch.cat([torch.zeros_like(image_latents), image_latents])
        inputs = torch.cat([torch.cat([noisy, noisy]).to(condition.dtype), condition], 1)
        timesteps = torch.full((len(inputs),), timestep, device=inputs.device)
        unconditional, conditional = self.unet(inputs, timesteps, context).sample.to(noisy.dtype).chunk(2)
        return unconditional + self.settings.guidance_scale * (conditional - unconditional)

    def tokens(self, views: Sequence[GuidanceView]) -> Float[Tensor, "b 1 c"]:
        """Return the cross-attention token of every view, from its frame and relative pose."""
        variant = self.settings.variant
        poses = torch.stack([relative_pose(view.camera, self.input_camera, variant) for view in views])
        embeddings = self.embeddings[self._rows(views)]
        with torch.no_grad():
            poses = to_device_async(poses.to(embeddings.dtype), embeddings.device)
            return self.camera_projection(torch.cat([embeddings, poses], -1))[:, None]

    def _rows(self, views: Sequence[GuidanceView]) -> Int64[Tensor, " b"]:
        """Return the frame indices of some views."""
        known = len(self.embeddings)
        if wrong := [view.frame for view in views if not 0 <= view.frame < known]:
            raise BadInput(f"frame {wrong[0]} is not in the prior; it has frames 0 to {known - 1}")
        return to_device_async(torch.tensor([view.frame for view in views]), self.embeddings.device)


def relative_pose(
    camera: OrbitCamera, input_camera: OrbitCamera, variant: Literal["xl", "stable"] = "xl"
) -> Float[Tensor, " 4"]:
    """Return the relative pose in Zero-1-to-3's convention.

    The polar angle is measured from the pole above, so a camera that moves up has a negative difference; azimuths
    increase in the same direction as ours.

    Args:
        camera: of the novel view.
        input_camera: of the input image.
        variant: stable: the last number is the polar angle of the input camera, radians; xl: it is the difference of
            the radii, world units.

    Returns:
        [polar difference in radians, sine and cosine of the azimuth difference, last number], float64.
    """
    polar = math.radians(input_camera.elevation_deg - camera.elevation_deg)
    azimuth = math.radians(camera.azimuth_deg - input_camera.azimuth_deg)
    last = camera.radius - input_camera.radius
    if variant == "stable":
        last = math.radians(90 - input_camera.elevation_deg)
    return torch.tensor([polar, math.sin(azimuth), math.cos(azimuth), last], dtype=torch.float64)
