"""Temporal metrics of two videos of one view; frames in [0, 1], over the same background.

Frames of integers raise BadInput.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.metrics.image import as_float

BLUR_SHARE = 1 / 32  # of the frame height: tolerance for misplaced changes (ours)
EPS = 1e-9  # avoids division by zero for a still ground truth


def flicker(
    frames: Float[Tensor, "t h w c"], ground_truth: Float[Tensor, "t h w c"], region: Float[Tensor, "t h w 1"]
) -> Float[Tensor, ""]:
    """Return the mean difference of the changes from frame to frame, in levels of 255; 0 is best.

    A view that is a few degrees off scores worse than a still one; read it together with `temporal_error`.

    Args:
        frames: to compare, two or more.
        ground_truth: reference frames.
        region: 1 where either video shows the subject; a change counts if the subject is there before or after it.
    """
    difference = (_changes(frames) - _changes(ground_truth)).abs().mean(-1, keepdim=True)
    counted = torch.maximum(region[1:], region[:-1]).to(difference)
    return 255 * (difference * counted).sum() / counted.sum().clamp_min(1)


def temporal_error(frames: Float[Tensor, "t h w c"], ground_truth: Float[Tensor, "t h w c"]) -> Float[Tensor, ""]:
    """Return the error of the amount, place and time of changes, with tolerance for small misplacements.

    The absolute changes of both videos (two frames or more) are blurred by a Gaussian with sigma 1/32 of the height;
    the result is the L1 norm of their difference, relative to the ground truth's changes. 0 is the true motion, 1 a
    still video, more is worse than still. For a still ground truth the slightest change gives a huge value.
    """
    ours, theirs = (_blurred(_changes(video).abs().mean(-1)) for video in (frames, ground_truth))
    return (ours - theirs).abs().sum() / theirs.sum().clamp_min(EPS)


def motion_amount(frames: Float[Tensor, "t h w c"], ground_truth: Float[Tensor, "t h w c"]) -> Float[Tensor, ""]:
    """Return the total change relative to the ground truth's: 1 is equal, 0 a still video."""
    return _changes(frames).abs().sum() / _changes(ground_truth).abs().sum().clamp_min(EPS)


def _changes(frames: Float[Tensor, "t h w c"]) -> Float[Tensor, "t-1 h w c"]:
    return as_float(frames).diff(dim=0)


def _blurred(planes: Float[Tensor, "t h w"]) -> Float[Tensor, "t h w"]:
    height, width = planes.shape[1:]
    sigma = height * BLUR_SHARE
    return _blur(height, sigma, planes) @ planes @ _blur(width, sigma, planes).mT


def _blur(size: int, sigma: float, like: Tensor) -> Float[Tensor, "n n"]:
    """Return the Gaussian filter of a row as a matrix, truncated at four sigma, with mirrored ends."""
    reach = int(4 * sigma + 0.5)
    steps = torch.arange(-reach, reach + 1, device=like.device)
    weights = torch.exp(-(steps / sigma).square() / 2).to(like)
    positions = (torch.arange(size, device=like.device)[:, None] + steps) % (2 * size)
    mirrored = torch.where(positions < size, positions, 2 * size - 1 - positions)
    return like.new_zeros(size, size).scatter_add_(1, mirrored, (weights / weights.sum()).expand(size, -1).contiguous())
