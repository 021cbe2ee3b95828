"""Analytic denoiser of a known picture, the prior without weights.

If the clean picture z0 of a view is known, the noise in x_t is (x_t - sqrt(alphabar) z0) / sqrt(1 - alphabar); the same
score distillation then converges to z0. In pixel space, over white, with the alpha as a fourth channel.

The drawn noise cancels: with x_t = sqrt(alphabar) z + sqrt(1 - alphabar) e, the gradient of score distillation is
(1 - alphabar) (noise_pred - e) = sqrt(alphabar (1 - alphabar)) (z - z0). So no noise is drawn here.
"""

from collections.abc import Callable, Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import mse_loss

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.diffusion.noise_schedule import alphas_cumprod
from dg4d_lib.guidance.distillation import TimestepSchedule
from dg4d_lib.guidance.interface import GuidanceView

LATENT_NUMBERS = 4 * 32 * 32  # latent size of Zero-1-to-3; pixel pictures are weighted as if they had this size

CleanPictures = Callable[[Sequence[GuidanceView]], tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 1"]]]


class AnalyticPrior:
    """Score distillation towards known pictures.

    Args:
        clean: color over white and alpha of every view, at its camera's size.
        schedule: of the timestep.
        viewpoints: cameras that `clean` supports; None: all.
        frames: frames that `clean` supports; None: all.
        weight: factor on the loss.
        weights: factor in place of `weight`, by frame.
    """

    def __init__(
        self,
        clean: CleanPictures,
        schedule: TimestepSchedule,
        viewpoints: tuple[OrbitCamera, ...] | None = None,
        frames: tuple[int, ...] | None = None,
        weight: float = 1.0,
        weights: Mapping[int, float] | None = None,
    ) -> None:
        self.clean, self.schedule, self.weight, self.weights = clean, schedule, weight, weights or {}
        self.viewpoints, self.frames = viewpoints, frames

    def loss(
        self,
        images: Float[Tensor, "b h w 3"],
        alpha: Float[Tensor, "b h w 1"],
        views: Sequence[GuidanceView],
        progress: float,
        generator: torch.Generator,
    ) -> Float[Tensor, ""]:
        """Return the weighted distance of the renders from the known images."""
        timestep = self.schedule.timestep(progress, generator)
        alphabar = float(alphas_cumprod()[timestep])
        color, clean_alpha = (picture.to(images.device) for picture in self.clean(views))
        pixels = 3 * images.shape[1] * images.shape[2]
        strength = 0.5 * (alphabar * (1 - alphabar)) ** 0.5
        squares = (
            mse_loss(image, known, reduction="sum") + mse_loss(cover, known_cover, reduction="sum")
            for image, known, cover, known_cover in zip(
                *map(torch.unbind, (images, color, alpha, clean_alpha)), strict=True
            )
        )
        weights = [self.weights.get(view.frame, self.weight) for view in views]
        error = torch.stack([weight * square for weight, square in zip(weights, squares, strict=True)]).mean()
        # pixels are diffused as 2 x - 1, so squares are four times those of color and alpha in [0, 1]
        return error * (4 * strength * LATENT_NUMBERS / pixels)
