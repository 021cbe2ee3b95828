"""Refiners: image-to-image and video-to-video diffusion that improve renders of a moving textured mesh."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.diffusion.latents import decode_images, encode_images
from dg4d_lib.diffusion.noise_schedule import add_noise, ddim_step, ddim_timesteps
from dg4d_lib.diffusion.video_model import VideoModel, karras_sigmas, start_index
from dg4d_lib.guidance.interface import GuidanceView
from dg4d_lib.guidance.zero123 import ConditionedZero123
from dg4d_lib.images import resize
from dg4d_lib.refiner_settings import ImageToImageSettings, VideoToVideoSettings


@runtime_checkable
class Refiner(Protocol):
    """Interface of models that improve rendered frames."""

    def refine(
        self,
        video: Float[Tensor, "t h w 3"],
        cameras: Sequence[OrbitCamera],
        progress: float,
        generator: torch.Generator,
    ) -> Float[Tensor, "t h w 3"]:
        """Return improved frames with the same content and viewpoints.

        Args:
            video: the mesh over white, in [0, 1], one image per frame of the driving video.
            cameras: camera of every image.
            progress: 0 in the first iteration of the texture optimization, 1 in the last.
            generator: random numbers for the noise.
        """
        ...


def noise_levels(settings: VideoToVideoSettings, progress: float) -> tuple[float, ...]:
    """Return the noise levels of one refinement, the largest first, and a final 0.

    Args:
        settings: number of steps, and the strength in the first and in the last iteration.
        progress: 0 in the first iteration of the texture optimization, 1 in the last.
    """
    strength, steps = settings.strength, settings.model.num_inference_steps
    if settings.strength_end:
        strength += progress * (settings.strength_end - strength)
    return karras_sigmas(steps)[start_index(steps, strength) :]


class VideoToVideo:
    """SDEdit-style refiner: adds noise to the video and denoises it with Stable Video Diffusion.

    The model is conditioned on the input picture.
    """

    def __init__(self, settings: VideoToVideoSettings, model: VideoModel, picture: Float[Tensor, "h w 3"]) -> None:
        """Store settings, model and picture.

        Args:
            settings: number of steps, and the share of the schedule that an iteration uses.
            model: Stable Video Diffusion, loaded.
            picture: the input picture over white, in [0, 1].
        """
        self.settings, self.model = settings, model
        self._picture = picture

    def refine(
        self,
        video: Float[Tensor, "t h w 3"],
        cameras: Sequence[OrbitCamera],
        progress: float,
        generator: torch.Generator,
    ) -> Float[Tensor, "t h w 3"]:
        """Return the denoised video; `cameras` are not used."""
        sigmas = noise_levels(self.settings, progress)
        condition = self.model.encode_condition(resize(self._picture[None], video.shape[1:3])[0], [generator])
        latents = self.model.encode(video)[None]
        noisy = latents + sigmas[0] * self.model.sample_noise(latents.shape, [generator])
        return self.model.decode(self.model.denoise(noisy, condition, sigmas)[0]).to(video)


class ImageToImage:
    """SDEdit-style refiner: adds noise to every image and denoises it with Zero-1-to-3, given its frame and camera.

    The strength decreases over the iterations, as in DreamGaussian (Tang et al. 2024).
    """

    def __init__(self, settings: ImageToImageSettings, prior: ConditionedZero123) -> None:
        """Store the schedule and the prior, which must be conditioned on the frames of the driving video."""
        self.settings, self.prior = settings, prior

    @torch.no_grad()
    def refine(
        self,
        video: Float[Tensor, "t h w 3"],
        cameras: Sequence[OrbitCamera],
        progress: float,
        generator: torch.Generator,
    ) -> Float[Tensor, "t h w 3"]:
        """Return the denoised images, upscaled from the 256 pixels of Zero-1-to-3."""
        settings, prior, scale = self.settings, self.prior, float(self.prior.vae.config.scaling_factor)
        strength = settings.strength_start + progress * (settings.strength_end - settings.strength_start)
        steps = settings.num_inference_steps
        timesteps = ddim_timesteps(steps)[start_index(steps, strength) :]
        tokens = prior.tokens([GuidanceView(camera, frame) for frame, camera in enumerate(cameras)])
        renders = video.to(prior.vae.device)

        def denoise(batch: slice) -> Float[Tensor, "p h w 3"]:
            latents = scale * encode_images(prior.vae, renders[batch])
            latents = add_noise(latents, noise[batch].to(latents), timesteps[0])
            for timestep, next_timestep in pairwise((*timesteps, 0)):
                noise_pred = prior.predict_noise(latents, timestep, prior.latents[batch], tokens[batch])
                latents = ddim_step(latents, noise_pred, timestep, next_timestep)
            images = decode_images(prior.vae, (latents / scale).to(prior.vae.dtype), latents.dtype)
            return resize(images, video.shape[1:3])

        noise = torch.randn((len(video), *prior.latents.shape[1:]), dtype=video.dtype, generator=generator)
        return torch.cat(prior.batches.run(denoise, len(renders))).to(video)
