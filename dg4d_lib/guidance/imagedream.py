"""ImageDream: four consistent views of an object, conditioned on an image of its front (Wang and Shi 2023).

It generates the views that LGM reconstructs, and serves as a guidance prior. Only this module uses its conventions: z
up, the front of the object at azimuth 90, cameras on the unit sphere.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.cameras.viewpoints import turntable
from dg4d_lib.devices import to_device_async
from dg4d_lib.diffusion.batching import MicroBatches
from dg4d_lib.diffusion.checkpoints import load_checkpoint
from dg4d_lib.diffusion.clip_images import clip_pixels
from dg4d_lib.diffusion.components import (
    TRANSFORMERS_FILES,
    Placement,
    compute_dtype,
    load_component,
    load_vae,
    weights_file,
)
from dg4d_lib.diffusion.latents import LATENT_CHANNELS, LATENT_SIZE, at_least_float32, decode_images, encode_images
from dg4d_lib.diffusion.noise_schedule import SCHEDULE, ddim_step, ddim_timesteps, require_schedule
from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.guidance.distillation import TimestepSchedule, distill_in_pieces, require_finite_conditioning
from dg4d_lib.guidance.imagedream_unet import MultiViewUnet, MultiViewUnetConfig
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.settings import ImageDreamPriorSettings, Precision

RING = 4  # views denoised together, at azimuth steps of 90 degrees
FRONT_DEG = 90.0  # ImageDream's azimuth of the conditioning image

RESIDENT_GB = {"fp16": 6.0, "bf16": 6.0, "fp32": 10.0}  # measured: weights (3.9 or 7.8), renders, CUDA context
RING_GB = {"fp16": 2.0, "bf16": 2.0, "fp32": 4.0}  # measured: VAE activations of four views, workspace


@dataclass(frozen=True)
class ImageDreamCondition:
    """Conditioning on s objects.

    Attributes:
        prompt_embeds: tokens of the prompt.
        negative_prompt_embeds: tokens of the empty prompt, for classifier-free guidance.
        image_embeds: CLIP features of an image.
        image_latents: of the same image, by the VAE; an additional view for the network.
    """

    prompt_embeds: Float[Tensor, "s l d"]
    negative_prompt_embeds: Float[Tensor, "s l d"]
    image_embeds: Float[Tensor, "s m e"]
    image_latents: Float[Tensor, "s 4 32 32"]

    def rows(self, objects: Sequence[int]) -> "ImageDreamCondition":
        """Return the conditioning of some objects, in this order."""
        selected = to_device_async(torch.tensor(list(objects)), self.image_latents.device)
        return ImageDreamCondition(**{item.name: getattr(self, item.name)[selected] for item in fields(self)})


class ImageDream:
    """Frozen networks of ImageDream on one device.

    Attributes:
        unet: predicts noise.
        vae: AutoencoderKL.
        image_encoder: CLIPVisionModel.
        text_encoder: CLIPTextModel.
        tokenizer: CLIPTokenizer.
    """

    def __init__(self, unet: MultiViewUnet, vae: Any, image_encoder: Any, text_encoder: Any, tokenizer: Any) -> None:
        self.unet, self.vae, self.image_encoder = unet, vae, image_encoder
        self.text_encoder, self.tokenizer = text_encoder, tokenizer

    @classmethod
    def load(cls, model: Path, precision: Precision, device: torch.device) -> "ImageDream":
        """Read the networks from a folder with the layout of `ashawkey/imagedream-ipmv-diffusers`.

        Args:
            model: the folder.
            precision: of the networks on a GPU; CPUs use float32.
            device: of the networks.

        Raises:
            BadInput: a file is missing or damaged, or the noise schedule is another.
            BackendUnavailable: diffusers or transformers is not installed.
        """
        try:
            from transformers import CLIPTextModel, CLIPTokenizer, CLIPVisionModel  # noqa: PLC0415 - takes seconds
            from transformers.utils.logging import disable_progress_bar  # noqa: PLC0415
        except ImportError as error:
            raise BackendUnavailable(
                f"ImageDream needs packages that are not installed ({error}); run `make setup CUDA=1`"
            ) from error
        disable_progress_bar()
        placement = Placement(device, compute_dtype(device, precision), channels_last=device.type == "cuda")
        require_schedule(model, SCHEDULE)
        try:
            config = MultiViewUnetConfig.of(json.loads((model / "unet" / "config.json").read_text(encoding="utf-8")))
            tokenizer = CLIPTokenizer.from_pretrained(model / "tokenizer", local_files_only=True)
        except (OSError, ValueError, TypeError) as error:
            raise BadInput(f"{model} holds no ImageDream model: {error}") from error
        file = weights_file(model / "unet", half=placement.dtype == torch.float16)
        return cls(
            load_checkpoint(lambda tensors: MultiViewUnet(config), file, placement),
            load_vae(model, placement),
            load_component(CLIPVisionModel, model / "image_encoder", placement, TRANSFORMERS_FILES),
            load_component(CLIPTextModel, model / "text_encoder", placement, TRANSFORMERS_FILES),
            tokenizer,
        )

    @torch.no_grad()
    def conditioned_on(self, images: Float[Tensor, "s h w 3"], prompt: str = "") -> ImageDreamCondition:
        """Encode the conditioning on images.

        Args:
            images: of the front of every object, over white, in [0, 1], square.
            prompt: of all of them; may be empty.

        Raises:
            BadInput: the networks overflow, so that the encoding of an image is not finite.
            BackendUnavailable: a single image does not fit into memory.
        """

        def embed(piece: slice) -> tuple[Tensor, Tensor]:
            pixels = clip_pixels(images[piece]).to(self.image_encoder.device, self.image_encoder.dtype)
            features = self.image_encoder(pixels, output_hidden_states=True).hidden_states[-2]
            return features, self.encode(images[piece])

        batches = MicroBatches("frames for ImageDream", RING)  # a ring of renders has to fit anyway
        image_embeds, latents = (torch.cat(parts) for parts in zip(*batches.run(embed, len(images)), strict=True))
        require_finite_conditioning(image_embeds, latents)
        positive, negative = (self._encode_prompt(text).expand(len(images), -1, -1) for text in (prompt, ""))
        return ImageDreamCondition(positive, negative, image_embeds, latents)

    @torch.no_grad()
    def views(
        self,
        condition: ImageDreamCondition,
        generator: torch.Generator,
        num_inference_steps: int = 30,
        guidance_scale: float = 5.0,
        elevation_deg: float = 0.0,
    ) -> Float[Tensor, "4 h w 3"]:
        """Sample images at azimuth 0, 90, 180, 270, in [0, 1], by deterministic DDIM (Song et al. 2021).

        Args:
            condition: of one object.
            generator: of the initial noise.
            num_inference_steps: of the sampler.
            guidance_scale: classifier-free guidance.
            elevation_deg: of the four cameras.
        """
        cameras = turntable(RING, OrbitCamera(elevation_deg))
        shape = (1, RING, LATENT_CHANNELS, LATENT_SIZE, LATENT_SIZE)
        latents = torch.randn(shape, generator=generator, dtype=condition.image_latents.dtype)
        latents = latents.to(condition.image_latents.device)
        for timestep, next_timestep in pairwise((*ddim_timesteps(num_inference_steps), 0)):
            noise_pred = self.predict_noise(latents, timestep, [cameras], condition, guidance_scale)
            latents = ddim_step(latents, noise_pred, timestep, next_timestep)
        unscaled = latents[0].to(self.vae.dtype) / self.vae.config.scaling_factor
        return decode_images(self.vae, unscaled, at_least_float32(self.vae.dtype))

    @torch.no_grad()
    def predict_noise(
        self,
        latents: Float[Tensor, "s v 4 32 32"],
        timestep: int,
        rings: Sequence[Sequence[OrbitCamera]],
        condition: ImageDreamCondition,
        guidance_scale: float,
    ) -> Float[Tensor, "s v 4 32 32"]:
        """Predict the noise of s sets of v views with classifier-free guidance: e_u + guidance_scale (e_c - e_u).

        The unconditional half has an empty prompt, and zero image embeddings and latents.

        Args:
            latents: noisy latents.
            timestep: 0 to 999.
            rings: cameras of every set.
            condition: on the object of every set.
            guidance_scale: classifier-free guidance.
        """
        like = next(self.unet.parameters())
        text = torch.cat([condition.negative_prompt_embeds, condition.prompt_embeds]).to(like)
        image_embeds, image_latents = (
            torch.cat([torch.zeros_like(value), value]).to(like)
            for value in (condition.image_embeds, condition.image_latents)
        )
        poses = torch.stack([torch.stack([camera_to_world_rows(camera) for camera in ring]) for ring in rings])
        poses = pad(poses, (0, 0, 0, 1)).repeat(2, 1, 1)  # the conditioning image has no camera
        poses = to_device_async(poses.to(like.dtype), like.device)
        inputs = torch.cat([latents.repeat(2, 1, 1, 1, 1).to(like), image_latents[:, None]], 1)
        noise_pred = self.unet(inputs, timestep, poses, text, image_embeds)[:, :-1].to(latents)
        unconditional, conditional = noise_pred.chunk(2)
        return unconditional + guidance_scale * (conditional - unconditional)

    def encode(self, images: Float[Tensor, "b h w 3"]) -> Float[Tensor, "b 4 32 32"]:
        """Encode images in [0, 1] to the scaled mode of their latents, in the images' precision; differentiable."""
        return self.vae.config.scaling_factor * encode_images(self.vae, images.to(self.vae.device))

    def _encode_prompt(self, text: str) -> Float[Tensor, "1 l d"]:
        tokens = self.tokenizer(
            text,
            padding="max_length",
            max_length=self.tokenizer.model_max_length,
            truncation=True,
            return_tensors="pt",
        )
        return self.text_encoder(tokens.input_ids.to(self.text_encoder.device))[0]


@dataclass(frozen=True)
class ImageDreamPrior:
    """Guidance prior that scores rings of four renders as views of one object.

    Attributes:
        model: the networks.
        condition: on the object at every frame.
        schedule: of the timestep.
        settings: guidance, precision and memory.
        ring_size: number of cameras scored together, at equal steps of azimuth.
    """

    model: ImageDream
    condition: ImageDreamCondition
    schedule: TimestepSchedule
    settings: ImageDreamPriorSettings
    viewpoints: tuple[OrbitCamera, ...] | None = field(default=None, init=False)
    frames: tuple[int, ...] | None = field(default=None, init=False)
    ring_size: int = field(default=RING, init=False)

    @cached_property
    def batches(self) -> MicroBatches:
        """Micro-batches of rings."""
        precision: Precision = self.settings.precision
        return MicroBatches.within(
            "rings of four views for the prior", self.settings.memory_gb, RESIDENT_GB[precision], RING_GB[precision]
        )

    def loss(
        self,
        images: Float[Tensor, "b h w 3"],
        alpha: Float[Tensor, "b h w 1"],
        views: Sequence[GuidanceView],
        progress: float,
        generator: torch.Generator,
    ) -> Float[Tensor, ""]:
        """Return the distillation loss of the renders, of which every four form a ring; alpha is ignored.

        Raises:
            BadInput: the views form no rings.
            BackendUnavailable: a single ring does not fit into memory.
        """
        rings = [views[start : start + RING] for start in range(0, len(views), RING)]
        if not all(_is_ring(ring) for ring in rings):
            raise BadInput(
                f"ImageDream needs groups of {RING} views of a frame, 90 degrees apart; given {len(views)} views that "
                f"form no such groups; set static.views and motion.views to multiples of {RING}"
            )
        condition = self.condition.rows([ring[0].frame for ring in rings])
        cameras = [[view.camera for view in ring] for ring in rings]
        timestep = self.schedule.timestep(progress, generator)
        shape = (len(rings), RING * LATENT_CHANNELS, LATENT_SIZE, LATENT_SIZE)
        noise = to_device_async(
            torch.randn(shape, dtype=images.dtype, generator=generator), self.condition.image_latents.device
        )

        def encode(pixels: Float[Tensor, "p rows w 3"]) -> Float[Tensor, "p c 32 32"]:
            latents = self.model.encode(pixels.unflatten(1, (RING, -1)).flatten(0, 1))
            return latents.unflatten(0, (-1, RING)).flatten(1, 2)

        def predict_noise(noisy: Float[Tensor, "p c 32 32"], timestep: int, piece: slice) -> Float[Tensor, "p c 32 32"]:
            of_piece = condition.rows(range(len(rings))[piece])
            ring = noisy.unflatten(1, (RING, LATENT_CHANNELS))
            scale = self.settings.guidance_scale
            noise_pred = self.model.predict_noise(ring, timestep, cameras[piece], of_piece, scale)
            return noise_pred.flatten(1, 2)

        stacked = images.unflatten(0, (-1, RING)).flatten(
            1, 2
        )  # a ring becomes one tall image, so that micro-batches never split it
        return distill_in_pieces(stacked, encode, predict_noise, timestep, noise, self.batches) / RING


def camera_to_world_rows(camera: OrbitCamera) -> Float[Tensor, "16"]:
    """Return ImageDream's camera vector: camera to world by rows, OpenGL axes, z up, radius 1; float64."""
    rotated = OrbitCamera(camera.elevation_deg, camera.azimuth_deg + FRONT_DEG, radius=1.0)
    pose = rotated.viewmat().inverse() @ torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64).diag()
    right, up, front, last = pose
    return torch.cat([right, -front, up, last])


def _is_ring(views: Sequence[GuidanceView]) -> bool:
    first = views[0]
    same = all(v.frame == first.frame and v.camera.elevation_deg == first.camera.elevation_deg for v in views)
    angles = [(view.camera.azimuth_deg - first.camera.azimuth_deg) % 360 for view in views]
    even = all(math.isclose(angle, 360 / RING * i, abs_tol=1e-3) for i, angle in enumerate(angles))
    return len(views) == RING and same and even
