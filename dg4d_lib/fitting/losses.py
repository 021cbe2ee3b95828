"""Reference-view loss of both stages, error over filters of several widths, and the check for non-finite values."""

import math
from collections.abc import Iterable, Mapping
from functools import cache

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
OVERFLOW_ADVICE = "the diffusion prior overflows in its precision; set prior.precision=bf16 or fp32"
LEVELS = (1, 4, 8)  # widths of the filters over pictures that a pyramid compares, pixels; 1: none


def resize_cutouts(
    cutouts: Float[Tensor, "t h w 4"], size: int
) -> tuple[Float[Tensor, "t s s 3"], Float[Tensor, "t s s 1"]]:
    """Resize cut-outs with premultiplied alpha and antialiasing; return color over white and alpha.

    The results are stored channels first, as renderings are, so that losses read both in the same order.
    """
    alpha = cutouts[..., 3:]
    both = torch.cat([cutouts[..., :3] * alpha, alpha], -1).permute(0, 3, 1, 2).contiguous()
    if both.shape[-1] != size or both.shape[-2] != size:
        both = resize_planes(both, (size, size))
    color, alpha = both[:, :3] + 1 - both[:, 3:], both[:, 3:].contiguous()
    return color.permute(0, 2, 3, 1), alpha.permute(0, 2, 3, 1)


def pyramid_error(ours: Float[Tensor, "b h w c"], theirs: Float[Tensor, "b h w c"]) -> Float[Tensor, ""]:
    """Return the mean squared error, averaged over filters of several widths.

    Each is a mean over squares of half the width and three of three by three of these, which is nearly a Gaussian.
    """
    return torch.stack([level.square().mean() for level in _pyramid(ours - theirs)]).mean()


def pyramid_residuals(ours: Float[Tensor, "b h w c"], theirs: Float[Tensor, "b h w c"]) -> Float[Tensor, "b r"]:
    """Return the filtered differences of every picture, scaled so that their squares sum to its `pyramid_error`."""
    levels = [level.flatten(1) for level in _pyramid(ours - theirs)]
    return torch.cat([level / math.sqrt(level.shape[1] * len(levels)) for level in levels], 1)


def reference_loss(
    rendering: Rendering,
    color: Float[Tensor, "b h w 3"],
    alpha: Float[Tensor, "b h w 1"],
    color_weight: float,
    alpha_weight: float,
    ssim_weight: float = 0.0,
) -> Float[Tensor, ""]:
    """Return the weighted mean squared errors of color and alpha, means over images, pixels and channels.

    With `ssim_weight` also 1 - SSIM of the colors (3DGS; not in the paper).
    """
    loss = color_weight * functional.mse_loss(rendering.color, color)
    loss = loss + alpha_weight * functional.mse_loss(rendering.alpha, alpha)
    return loss + ssim_weight * (1 - ssim(rendering.color, color).mean()) if ssim_weight else loss


def check_finite(
    stage: str,
    losses: Mapping[str, Tensor],
    gradients: Iterable[Tensor | None],
    iteration: str,
    advice: str,
    gaussians: Gaussians,
) -> dict[str, float]:
    """Return the losses of an iteration as numbers; raise if the total loss or a gradient is not finite.

    A Gaussian with non-finite parameters is not drawn and its loss stays finite, so gradients are checked too. All
    values are copied at once, so that a GPU is synchronized only once.

    Args:
        stage: name of the fit.
        losses: scalars by name; "loss" is the minimized total. If "guidance" is not finite and "reference" is, the
            prior overflows, and the message says so in place of `advice`.
        gradients: of the parameters; None is skipped.
        iteration: for the message, "iteration 3 of 200".
        advice: remedy for the message.
        gaussians: the cloud before this iteration.

    Raises:
        Diverged: "loss" or a gradient is not finite.
    """
    norm = get_total_norm([gradient for gradient in gradients if gradient is not None], torch.inf)
    *values, largest = torch.stack([*(loss.detach() for loss in losses.values()), norm]).tolist()
    numbers = dict(zip(losses, values, strict=True))
    if math.isfinite(numbers.get("reference", math.nan)) and not math.isfinite(numbers.get("guidance", 0.0)):
        advice = OVERFLOW_ADVICE
    for quantity, value in (("loss", numbers["loss"]), ("gradient", largest)):
        if not math.isfinite(value):
            raise Diverged(f"{stage}: the {quantity} became {value} at {iteration}; {advice}", gaussians.detach())
    return numbers


class Diverged(FitDiverged):
    """Non-finite loss or gradient, with the last finite cloud for inspection.

    Attributes:
        gaussians: the cloud before the failed iteration.
    """

    def __init__(self, message: str, gaussians: Gaussians) -> None:
        super().__init__(message)
        self.gaussians = gaussians


def _pyramid(difference: Float[Tensor, "b h w c"]) -> list[Float[Tensor, "b c _ _"]]:
    planes = difference.movedim(-1, 1)
    levels = [planes]
    for width in LEVELS[1:]:
        rows, columns = (_filter(size, width, planes.dtype, planes.device) for size in planes.shape[-2:])
        levels.append(rows @ planes @ columns.mT)
    return levels


@cache
def _filter(size: int, width: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "_ {size}"]:
    """Return a level's filter along one axis as a matrix: a fourth of the time of avg_pool2d, which it equals."""
    filtered = functional.avg_pool1d(torch.eye(size, dtype=torch.float64)[None], width // 2)
    for _ in range(3):
        filtered = functional.avg_pool1d(filtered, 3, 1, 1)
    return filtered[0].T.to(device, dtype)
