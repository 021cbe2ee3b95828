"""ImageDream: how an object looks from four sides at once, given a picture of its front (Wang and Shi 2023).

It makes the views that LGM reconstructs, and can judge renders as a prior. Its conventions end
here: a world with z up, an object whose front is seen from azimuth 90, cameras on the unit sphere.
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
from dg4d_lib.guidance.distillation import TimestepSchedule, distill_in_pieces
from dg4d_lib.guidance.imagedream_unet import MultiViewUnet, MultiViewUnetConfig
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.settings import ImageDreamPriorSettings, Precision

RING = 4  # views that are denoised together, 90 degrees of azimuth apart
FRONT_DEG = 90.0  # ImageDream's azimuth of the picture it is given

RESIDENT_GB = {"fp16": 6.0, "bf16": 6.0, "fp32": 10.0}  # weights (3.9 or 7.8), renders and what CUDA takes
RING_GB = {"fp16": 2.0, "bf16": 2.0, "fp32": 4.0}  # what the VAE keeps of four views for its gradient, and workspace


@dataclass(frozen=True)
class ImageDreamCondition:
    """What the network is told about s objects.

    Attributes:
        text: tokens of a description.
        silence: tokens of no description, for classifier-free guidance.
        features: of a picture, by CLIP.
        latents: of the same picture, by the VAE; the network sees them as one more view.
    """

    text: Float[Tensor, "s l d"]
    silence: Float[Tensor, "s l d"]
    features: Float[Tensor, "s m e"]
    latents: Float[Tensor, "s 4 32 32"]

    def rows(self, objects: Sequence[int]) -> "ImageDreamCondition":
        """Some of the objects, in this order."""
        chosen = to_device_async(torch.tensor(list(objects)), self.latents.device)
        return ImageDreamCondition(**{part.name: getattr(self, part.name)[chosen] for part in fields(self)})


class ImageDream:
    """The networks, frozen, on one device.

    Attributes:
        unet: predicts noise.
        vae: pictures to latents and back.
        image_encoder: CLIP's eye.
        text_encoder: CLIP's reader.
        tokenizer: cuts text for it.
    """

    def __init__(self, unet: MultiViewUnet, vae: Any, image_encoder: Any, text_encoder: Any, tokenizer: Any) -> None:
        self.unet, self.vae, self.image_encoder = unet, vae, image_encoder
        self.text_encoder, self.tokenizer = text_encoder, tokenizer

    @classmethod
    def load(cls, model: Path, precision: Precision, device: torch.device) -> "ImageDream":
        """Read the networks from a folder with the layout of `ashawkey/imagedream-ipmv-diffusers`.

        Args:
            model: the folder.
            precision: of the networks, on a GPU; the processor computes in float32.
            device: where they will run.

        Raises:
            BadInput: a file is missing or damaged, or the model was trained with another noise.
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
            shape = MultiViewUnetConfig.of(json.loads((model / "unet" / "config.json").read_text(encoding="utf-8")))
            tokenizer = CLIPTokenizer.from_pretrained(model / "tokenizer", local_files_only=True)
        except (OSError, ValueError, TypeError) as error:
            raise BadInput(f"{model} is no ImageDream: {error}") from error
        file = weights_file(model / "unet", half=placement.dtype == torch.float16)
        return cls(
            load_checkpoint(lambda tensors: MultiViewUnet(shape), file, placement),
            load_vae(model, placement),
            load_component(CLIPVisionModel, model / "image_encoder", placement, TRANSFORMERS_FILES),
            load_component(CLIPTextModel, model / "text_encoder", placement, TRANSFORMERS_FILES),
            tokenizer,
        )

    @torch.no_grad()
    def conditioned_on(self, pictures: Float[Tensor, "s h w 3"], text: str = "") -> ImageDreamCondition:
        """What the network is to know.

        Args:
            pictures: of the front of every object, over white, in [0, 1], square.
            text: describes them; may be empty.
        """
        eye = clip_pixels(pictures).to(self.image_encoder.device, self.image_encoder.dtype)
        features = self.image_encoder(eye, output_hidden_states=True).hidden_states[-2]
        words, silence = (self._tokens(said).expand(len(pictures), -1, -1) for said in (text, ""))
        return ImageDreamCondition(words, silence, features, self.encode(pictures))

    @torch.no_grad()
    def views(
        self,
        condition: ImageDreamCondition,
        generator: torch.Generator,
        steps: int = 30,
        guidance: float = 5.0,
        elevation_deg: float = 0.0,
    ) -> Float[Tensor, "4 h w 3"]:
        """Pictures from azimuth 0, 90, 180, 270, in [0, 1], by DDIM without fresh noise (Song et al. 2021).

        Args:
            condition: of one object.
            generator: the source of the first noise.
            steps: of the sampler.
            guidance: classifier-free.
            elevation_deg: of the four cameras, above the object.
        """
        cameras = turntable(RING, OrbitCamera(elevation_deg))
        shape = (1, RING, LATENT_CHANNELS, LATENT_SIZE, LATENT_SIZE)
        latents = torch.randn(shape, generator=generator, dtype=condition.latents.dtype).to(condition.latents.device)
        for timestep, following in pairwise((*ddim_timesteps(steps), 0)):
            noise = self.predict_noise(latents, timestep, [cameras], condition, guidance)
            latents = ddim_step(latents, noise, timestep, following)
        unscaled = latents[0].to(self.vae.dtype) / self.vae.config.scaling_factor
        return decode_images(self.vae, unscaled, at_least_float32(self.vae.dtype))

    @torch.no_grad()
    def predict_noise(
        self,
        latents: Float[Tensor, "s v 4 32 32"],
        timestep: int,
        rings: Sequence[Sequence[OrbitCamera]],
        condition: ImageDreamCondition,
        guidance: float,
    ) -> Float[Tensor, "s v 4 32 32"]:
        """The noise in s sets of v views, with classifier-free guidance: e_u + guidance (e_c - e_u).

        Without guidance the network is told an empty text, a picture whose features and latents are zero.

        Args:
            latents: noisy.
            timestep: how noisy, 0 to 999.
            rings: the cameras of every set.
            condition: of the object of every set.
            guidance: classifier-free.
        """
        like = next(self.unet.parameters())
        text = torch.cat([condition.silence, condition.text]).to(like)
        features, fronts = (
            torch.cat([torch.zeros_like(told), told]).to(like) for told in (condition.features, condition.latents)
        )
        poses = torch.stack([torch.stack([camera_to_world_rows(camera) for camera in ring]) for ring in rings])
        poses = pad(poses, (0, 0, 0, 1)).repeat(2, 1, 1)  # the picture itself has no camera
        poses = to_device_async(poses.to(like.dtype), like.device)
        seen = torch.cat([latents.repeat(2, 1, 1, 1, 1).to(like), fronts[:, None]], 1)
        without, told = self.unet(seen, timestep, poses, text, features)[:, :-1].to(latents).chunk(2)
        return without + guidance * (told - without)

    def encode(self, pictures: Float[Tensor, "b h w 3"]) -> Float[Tensor, "b 4 32 32"]:
        """Scaled latents of pictures in [0, 1] (the mode, no sample), in their precision; with gradient."""
        return self.vae.config.scaling_factor * encode_images(self.vae, pictures.to(self.vae.device))

    def _tokens(self, text: str) -> Float[Tensor, "1 l d"]:
        cut = self.tokenizer(
            text,
            padding="max_length",
            max_length=self.tokenizer.model_max_length,
            truncation=True,
            return_tensors="pt",
        )
        return self.text_encoder(cut.input_ids.to(self.text_encoder.device))[0]


@dataclass(frozen=True)
class ImageDreamPrior:
    """A guidance prior: every ring of four renders is judged as views of one object.

    Attributes:
        model: the networks.
        condition: the object at every frame.
        noise: which timestep an iteration uses.
        settings: guidance, precision and memory.
        ring: how many cameras it judges together, at equal steps of azimuth.
    """

    model: ImageDream
    condition: ImageDreamCondition
    noise: TimestepSchedule
    settings: ImageDreamPriorSettings
    viewpoints: tuple[OrbitCamera, ...] | None = field(default=None, init=False)
    frames: tuple[int, ...] | None = field(default=None, init=False)
    ring: int = field(default=RING, init=False)

    @cached_property
    def batches(self) -> MicroBatches:
        """How many rings are judged at once."""
        precision: Precision = self.settings.precision
        return MicroBatches.within(
            "rings of four views for the prior", self.settings.memory_gb, RESIDENT_GB[precision], RING_GB[precision]
        )

    def loss(
        self,
        images: Float[Tensor, "b h w 3"],
        coverage: Float[Tensor, "b h w 1"],
        views: Sequence[GuidanceView],
        progress: float,
        generator: torch.Generator,
    ) -> Float[Tensor, ""]:
        """The distillation loss of the renders, each four of which are a ring; coverage is ignored.

        Raises:
            BadInput: the views form no rings.
            BackendUnavailable: there is no memory for a single ring.
        """
        rings = [views[start : start + RING] for start in range(0, len(views), RING)]
        if not all(_is_ring(ring) for ring in rings):
            raise BadInput(
                f"ImageDream judges {RING} views of a frame together, 90 degrees apart; given {len(views)} views that "
                f"are not so; choose static.views and motion.views as multiples of {RING}"
            )
        condition = self.condition.rows([ring[0].frame for ring in rings])
        cameras = [[view.camera for view in ring] for ring in rings]
        timestep = self.noise.timestep(progress, generator)
        shape = (len(rings), RING * LATENT_CHANNELS, LATENT_SIZE, LATENT_SIZE)
        noise = to_device_async(
            torch.randn(shape, dtype=images.dtype, generator=generator), self.condition.latents.device
        )

        def encode(pixels: Float[Tensor, "p rows w 3"]) -> Float[Tensor, "p c 32 32"]:
            latents = self.model.encode(pixels.unflatten(1, (RING, -1)).flatten(0, 1))
            return latents.unflatten(0, (-1, RING)).flatten(1, 2)

        def predict_noise(noisy: Float[Tensor, "p c 32 32"], timestep: int, piece: slice) -> Float[Tensor, "p c 32 32"]:
            told = condition.rows(range(len(rings))[piece])
            ring = noisy.unflatten(1, (RING, LATENT_CHANNELS))
            believed = self.model.predict_noise(ring, timestep, cameras[piece], told, self.settings.guidance_scale)
            return believed.flatten(1, 2)

        stacked = images.unflatten(0, (-1, RING)).flatten(1, 2)  # a ring is one tall picture, so that it stays together
        return distill_in_pieces(stacked, encode, predict_noise, timestep, noise, self.batches) / RING


def camera_to_world_rows(camera: OrbitCamera) -> Float[Tensor, "16"]:
    """The camera as ImageDream is told: camera to world by rows, OpenGL axes, z up, at radius 1; float64."""
    turned = OrbitCamera(camera.elevation_deg, camera.azimuth_deg + FRONT_DEG, radius=1.0)
    pose = turned.viewmat().inverse() @ torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64).diag()
    right, up, front, last = pose
    return torch.cat([right, -front, up, last])


def _is_ring(views: Sequence[GuidanceView]) -> bool:
    first = views[0]
    same = all(v.frame == first.frame and v.camera.elevation_deg == first.camera.elevation_deg for v in views)
    turns = [(view.camera.azimuth_deg - first.camera.azimuth_deg) % 360 for view in views]
    even = all(math.isclose(turn, 360 / RING * i, abs_tol=1e-3) for i, turn in enumerate(turns))
    return len(views) == RING and same and even
