"""What makes the pictures of a moving textured mesh better; the texture then follows them."""

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
from dg4d_lib.settings import ImageToImageSettings, VideoToVideoSettings


@runtime_checkable
class Refiner(Protocol):
    """Pictures in, better pictures out."""

    def refine(
        self,
        video: Float[Tensor, "t h w 3"],
        cameras: Sequence[OrbitCamera],
        progress: float,
        generator: torch.Generator,
    ) -> Float[Tensor, "t h w 3"]:
        """The same moments from the same viewpoints.

        Args:
            video: the mesh over white, in [0, 1], a picture per frame of the driving video.
            cameras: of every picture.
            progress: of the refinement, 0 in its first iteration and 1 in its last.
            generator: of noise.
        """
        ...


class VideoToVideo:
    """Noises the video and denoises it with Stable Video Diffusion, which knows the input picture."""

    def __init__(self, settings: VideoToVideoSettings, model: VideoModel, picture: Float[Tensor, "h w 3"]) -> None:
        """Choose how much noise.

        Args:
            settings: share of the schedule that is used.
            model: read from weights.
            picture: the input over white, in [0, 1].
        """
        self.model = model
        steps = settings.model.num_inference_steps
        self.sigmas = karras_sigmas(steps)[start_index(steps, settings.strength) :]
        self._picture = picture

    def refine(
        self,
        video: Float[Tensor, "t h w 3"],
        cameras: Sequence[OrbitCamera],
        progress: float,
        generator: torch.Generator,
    ) -> Float[Tensor, "t h w 3"]:
        """The denoised video; viewpoints and progress do not matter."""
        condition = self.model.encode_condition(resize(self._picture[None], video.shape[1:3])[0], [generator])
        latents = self.model.encode(video)[None]
        noisy = latents + self.sigmas[0] * self.model.sample_noise(latents.shape, [generator])
        return self.model.decode(self.model.denoise(noisy, condition, self.sigmas)[0]).to(video)


class ImageToImage:
    """Noises every picture on its own and denoises it with Zero-1-to-3, which knows its frame and its camera.

    Less noise from iteration to iteration, as in DreamGaussian (Tang et al. 2024).
    """

    def __init__(self, settings: ImageToImageSettings, prior: ConditionedZero123) -> None:
        """Choose the schedule; `prior` is conditioned on the frames of the driving video."""
        self.settings, self.prior = settings, prior

    @torch.no_grad()
    def refine(
        self,
        video: Float[Tensor, "t h w 3"],
        cameras: Sequence[OrbitCamera],
        progress: float,
        generator: torch.Generator,
    ) -> Float[Tensor, "t h w 3"]:
        """The denoised pictures; they have the 256 pixels of Zero-1-to-3 and are enlarged."""
        settings, prior, scale = self.settings, self.prior, float(self.prior.vae.config.scaling_factor)
        strength = settings.strength_start + progress * (settings.strength_end - settings.strength_start)
        steps = settings.num_inference_steps
        timesteps = ddim_timesteps(steps)[start_index(steps, strength) :]
        tokens = prior.tokens([GuidanceView(camera, frame) for frame, camera in enumerate(cameras)])
        renders = video.to(prior.vae.device)

        def denoised(piece: slice) -> Float[Tensor, "p h w 3"]:
            latents = scale * encode_images(prior.vae, renders[piece])
            latents = add_noise(latents, noise[piece].to(latents), timesteps[0])
            for timestep, following in pairwise((*timesteps, 0)):
                noise_pred = prior.predict_noise(latents, timestep, prior.latents[piece], tokens[piece])
                latents = ddim_step(latents, noise_pred, timestep, following)
            images = decode_images(prior.vae, (latents / scale).to(prior.vae.dtype), latents.dtype)
            return resize(images, video.shape[1:3])

        noise = torch.randn((len(video), *prior.latents.shape[1:]), dtype=video.dtype, generator=generator)
        return torch.cat(prior.batches.run(denoised, len(renders))).to(video)
