"""The reference-view loss of both stages, and the check that a loss is a number."""

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from dg4d_lib.errors import FitDiverged
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.rasterizer.interface import Rendering

WHITE = (1.0, 1.0, 1.0)


def resized(cutouts: Float[Tensor, "t h w 4"], size: int) -> tuple[Float[Tensor, "t s s 3"], Float[Tensor, "t s s 1"]]:
    """Color over white and alpha of cut-outs at another size, resampled with premultiplied alpha, antialiased."""
    alpha = cutouts[..., 3:]
    both = torch.cat([cutouts[..., :3] * alpha, alpha], -1).permute(0, 3, 1, 2)
    if both.shape[-1] != size or both.shape[-2] != size:
        both = functional.interpolate(both, (size, size), mode="bilinear", antialias=True, align_corners=False)
    both = both.permute(0, 2, 3, 1)
    alpha = both[..., 3:].contiguous()
    return (both[..., :3] + 1 - alpha).contiguous(), alpha


def reference_loss(
    rendering: Rendering,
    color: Float[Tensor, "b h w 3"],
    alpha: Float[Tensor, "b h w 1"],
    color_weight: float,
    alpha_weight: float,
) -> Float[Tensor, ""]:
    """Weighted mean squared errors of color and alpha, means over images, pixels and channels (METHOD section 3)."""
    return color_weight * functional.mse_loss(rendering.color, color) + alpha_weight * functional.mse_loss(
        rendering.alpha, alpha
    )


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
