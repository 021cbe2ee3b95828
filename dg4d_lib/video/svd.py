"""Driving videos from Stable Video Diffusion (Blattmann et al. 2023)."""

import math
from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.diffusion.video_model import SIGMA_MAX, VideoModel, karras_sigmas
from dg4d_lib.input_settings import SvdSettings
from dg4d_lib.video.canvas import cut_out, white_canvas
from dg4d_lib.video.driving import DrivingVideo


class StableVideo:
    """Image-to-video generator: animates the subject on a white background and mattes every frame.

    Attributes:
        notes: sentences for the user about deviations from the model's training and about failed matting.
    """

    def __init__(self, settings: SvdSettings, model: VideoModel) -> None:
        """Store the settings (number of frames, canvas size) and the loaded model."""
        self.settings, self.model = settings, model
        self.notes: tuple[str, ...] = ()
        if settings.frames != model.num_frames:
            self.notes = (f"The video model was trained on {model.num_frames} frames and generated {settings.frames}.",)

    def generate_all(
        self, subject: Float[Tensor, "h w 4"], generators: Sequence[torch.Generator]
    ) -> list[DrivingVideo]:
        """Generate a video per random generator in one batch; each as if generated alone, up to rounding.

        Args:
            subject: straight alpha, in [0, 1].
            generators: random numbers for the noise, on the CPU so that all devices agree; determine the motions.
        """
        canvas, (rows, columns) = white_canvas(subject, self.settings.height, self.settings.width)
        return [self._cut_out(frames[:, rows, columns], subject) for frames in self._sample(canvas, generators)]

    def _sample(
        self, canvas: Float[Tensor, "y x 3"], generators: Sequence[torch.Generator]
    ) -> Iterator[Float[Tensor, "t y x 3"]]:
        model, settings = self.model, self.settings
        condition = model.encode_condition(canvas, generators)
        shape = model.latent_shape(len(generators), settings.frames, *canvas.shape[:2])
        start = math.sqrt(SIGMA_MAX**2 + 1) * model.sample_noise(shape, generators)
        for latents in model.denoise(start, condition, karras_sigmas(settings.model.num_inference_steps)):
            yield model.decode(latents)

    def _cut_out(self, frames: Float[Tensor, "t y x 3"], subject: Float[Tensor, "h w 4"]) -> DrivingVideo:
        """Cut the subject out of frames, and note it if that fails."""
        video, notes = cut_out(frames, subject, self.settings.fps)
        self.notes = (*dict.fromkeys((*self.notes, *notes)),)
        return video
