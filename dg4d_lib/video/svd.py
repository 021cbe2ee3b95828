"""Driving videos from Stable Video Diffusion (Blattmann et al. 2023)."""

import math
from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.diffusion.video_model import SIGMA_MAX, VideoModel, karras_sigmas
from dg4d_lib.errors import BadInput
from dg4d_lib.images import over_white
from dg4d_lib.input_settings import SvdSettings
from dg4d_lib.video.driving import DrivingVideo
from dg4d_lib.video.framing import resample
from dg4d_lib.video.matting import matte_from_first_alpha

MATTING_FAILED = (
    "The subject could not be separated from the background of a generated video; it keeps the outline of the input."
)


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
            self.notes = (f"The video model was trained on {model.num_frames} frames and made {settings.frames}.",)

    def generate(self, subject: Float[Tensor, "h w 4"], generator: torch.Generator) -> DrivingVideo:
        """Generate one video.

        Args:
            subject: straight alpha, in [0, 1].
            generator: random numbers for the noise, on the CPU so that all devices agree; determines the motion.
        """
        return self.generate_all(subject, [generator])[0]

    def generate_all(
        self, subject: Float[Tensor, "h w 4"], generators: Sequence[torch.Generator]
    ) -> list[DrivingVideo]:
        """Generate a video per random generator in one batch; equal to `generate` up to rounding."""
        canvas, (rows, columns) = self._canvas(subject)
        return [self._cut_out(frames[:, rows, columns], subject) for frames in self._sample(canvas, generators)]

    def _canvas(self, subject: Float[Tensor, "h w 4"]) -> tuple[Float[Tensor, "y x 3"], tuple[slice, slice]]:
        """Scale the subject to a white canvas, centered; return the canvas and the rows and columns of the subject."""
        height, width = self.settings.height, self.settings.width
        scale = min(height / subject.shape[0], width / subject.shape[1])
        rows, columns = (round(side * scale) for side in subject.shape[:2])
        small = resample(subject[None], rows, columns)[0]
        top, left = (height - rows) // 2, (width - columns) // 2
        window = slice(top, top + rows), slice(left, left + columns)
        canvas = subject.new_ones((height, width, 3))
        canvas[window] = over_white(small)
        return canvas, window

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
        """Resize frames to the subject's size and matte them; if that fails, use the alpha of the input."""
        opaque = torch.cat([frames, torch.ones_like(frames[..., :1])], -1).to(subject)
        colors = resample(opaque, *subject.shape[:2])[..., :3]
        try:
            cutouts = matte_from_first_alpha(colors, subject[..., 3])
        except BadInput:
            self.notes = (*dict.fromkeys((*self.notes, MATTING_FAILED)),)
            cutouts = torch.cat([colors, subject[..., 3:].expand(len(colors), -1, -1, -1)], -1)
        return DrivingVideo(cutouts[..., :3], cutouts[..., 3:], self.settings.fps)
