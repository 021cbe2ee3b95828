"""The reference-view loss of both stages, and the check that losses are numbers."""

import math
from collections.abc import Iterable, Mapping

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional
from torch.nn.utils import get_total_norm

from dg4d_lib.errors import FitDiverged
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.images import resize_planes
from dg4d_lib.metrics.ssim import ssim
from dg4d_lib.rasterizer.interface import Rendering

WHITE = (1.0, 1.0, 1.0)


def resize_cutouts(
    cutouts: Float[Tensor, "t h w 4"], size: int
) -> tuple[Float[Tensor, "t s s 3"], Float[Tensor, "t s s 1"]]:
    """Color over white and alpha of cut-outs at another size, resampled with premultiplied alpha, antialiased.

    In memory they lie plane by plane, as renderings do: what compares the two reads both in one order.
    """
    alpha = cutouts[..., 3:]
    both = torch.cat([cutouts[..., :3] * alpha, alpha], -1).permute(0, 3, 1, 2).contiguous()
    if both.shape[-1] != size or both.shape[-2] != size:
        both = resize_planes(both, (size, size))
    color, alpha = both[:, :3] + 1 - both[:, 3:], both[:, 3:].contiguous()
    return color.permute(0, 2, 3, 1), alpha.permute(0, 2, 3, 1)


def reference_loss(
    rendering: Rendering,
    color: Float[Tensor, "b h w 3"],
    alpha: Float[Tensor, "b h w 1"],
    color_weight: float,
    alpha_weight: float,
    ssim_weight: float = 0.0,
) -> Float[Tensor, ""]:
    """Weighted mean squared errors of color and alpha, means over images, pixels and channels.

    With `ssim_weight` also how far the colors' structural similarity is from 1 (3DGS; the paper has none).
    """
    loss = color_weight * functional.mse_loss(rendering.color, color)
    loss = loss + alpha_weight * functional.mse_loss(rendering.alpha, alpha)
    return loss + ssim_weight * (1 - ssim(rendering.color, color).mean()) if ssim_weight else loss


def check_finite(
    stage: str,
    losses: Mapping[str, Tensor],
    slopes: Iterable[Tensor | None],
    moment: str,
    advice: str,
    gaussians: Gaussians,
) -> dict[str, float]:
    """The losses of an iteration, for people; stops a fit whose numbers are none.

    A Gaussian that is no number is not drawn and its loss stays finite, so gradients are checked too. All are read at
    once: a GPU is waited for a single time.

    Args:
        stage: name of the fit.
        losses: scalars by their names; "loss" is what is minimized.
        slopes: the gradients; None is left out.
        moment: "iteration 3 of 200".
        advice: what the user can do.
        gaussians: the last good cloud.

    Raises:
        Diverged: "loss" or a gradient is not finite.
    """
    steepest = get_total_norm([slope for slope in slopes if slope is not None], torch.inf)
    *values, slope = torch.stack([*(loss.detach() for loss in losses.values()), steepest]).tolist()
    numbers = dict(zip(losses, values, strict=True))
    for quantity, value in (("loss", numbers["loss"]), ("gradient", slope)):
        if not math.isfinite(value):
            raise Diverged(f"{stage}: the {quantity} became {value} at {moment}; {advice}", gaussians.detach())
    return numbers


class Diverged(FitDiverged):
    """A loss that is no number; carries the last good cloud so that it can be looked at.

    Attributes:
        gaussians: the cloud before the step that failed.
    """

    def __init__(self, message: str, gaussians: Gaussians) -> None:
        super().__init__(message)
        self.gaussians = gaussians
