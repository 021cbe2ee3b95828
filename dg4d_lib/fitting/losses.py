"""The reference-view loss of both stages, and the check that a loss is a number."""

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from dg4d_lib.errors import FitDiverged
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.metrics.ssim import ssim
from dg4d_lib.rasterizer.interface import Rendering

WHITE = (1.0, 1.0, 1.0)


def resized(cutouts: Float[Tensor, "t h w 4"], size: int) -> tuple[Float[Tensor, "t s s 3"], Float[Tensor, "t s s 1"]]:
    """Color over white and alpha of cut-outs at another size, resampled with premultiplied alpha, antialiased.

    In memory they lie plane by plane, as renderings do: what compares the two reads both in one order.
    """
    alpha = cutouts[..., 3:]
    both = torch.cat([cutouts[..., :3] * alpha, alpha], -1).permute(0, 3, 1, 2).contiguous()
    if both.shape[-1] != size or both.shape[-2] != size:
        both = functional.interpolate(both, (size, size), mode="bilinear", antialias=True, align_corners=False)
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
    stage: str, quantity: str, values: Iterable[Tensor | None], moment: str, advice: str, gaussians: Gaussians
) -> None:
    """Stop a fit whose numbers are none.

    A Gaussian that is no number is not drawn and its loss stays finite, so gradients are checked too.

    Args:
        stage: name of the fit.
        quantity: what is checked, "loss" or "gradient".
        values: the tensors; None is left out.
        moment: "iteration 3 of 200".
        advice: what the user can do.
        gaussians: the last good cloud.

    Raises:
        Diverged: one of the values is not finite.
    """
    for value in values:
        if value is not None and not torch.isfinite(value).all():
            bad = value.detach()[~torch.isfinite(value.detach())].flatten()[0].item()
            raise Diverged(f"{stage}: the {quantity} became {bad} at {moment}; {advice}", gaussians.detach())


class Diverged(FitDiverged):
    """A loss that is no number; carries the last good cloud so that it can be looked at.

    Attributes:
        gaussians: the cloud before the step that failed.
    """

    def __init__(self, message: str, gaussians: Gaussians) -> None:
        super().__init__(message)
        self.gaussians = gaussians
