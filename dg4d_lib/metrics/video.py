"""How alike two films of one view are over time, and how much moves in them; frames in [0, 1], over one background."""

import torch
from jaxtyping import Float
from torch import Tensor

BLUR_SHARE = 1 / 32  # of the height of a frame: how far a change may lie from where it should be
NOTHING = 1e-9  # of change; divides where the truth stands still


def flicker(
    frames: Float[Tensor, "t h w c"], truth: Float[Tensor, "t h w c"], region: Float[Tensor, "t h w 1"]
) -> Float[Tensor, ""]:
    """How differently pixels change from frame to frame, in levels of 255; 0 is best.

    A view that is a few degrees off flickers more than one that stands still: read it beside `temporal_error`.

    Args:
        frames: what is judged, two frames or more.
        truth: what it should be.
        region: 1 where either film shows the subject; a change counts where the subject is before or after it.
    """
    counted = torch.maximum(region[1:], region[:-1])
    difference = (frames.diff(dim=0) - truth.diff(dim=0)).abs().mean(-1, keepdim=True)
    return 255 * (difference * counted).sum() / counted.sum().clamp_min(1)


def temporal_error(frames: Float[Tensor, "t h w c"], truth: Float[Tensor, "t h w c"]) -> Float[Tensor, ""]:
    """How much changes where and when, with tolerance for changes that are a little misplaced.

    The absolute changes of both films are blurred by a Gaussian of 1/32 of the height, and their differences are summed
    up in units of the truth's changes: 0 is the true motion, 1 is none at all, more is worse than none. Both films have
    two frames or more. Where the truth stands still there is no unit, and the slightest change gives a huge number.
    """
    ours, theirs = (_blurred(film.diff(dim=0).abs().mean(-1)) for film in (frames, truth))
    return (ours - theirs).abs().sum() / theirs.sum().clamp_min(NOTHING)


def motion_amount(frames: Float[Tensor, "t h w c"], truth: Float[Tensor, "t h w c"]) -> Float[Tensor, ""]:
    """How much changes in all, in units of the truth's changes: 1 is as much, 0 is a still film."""
    return frames.diff(dim=0).abs().sum() / truth.diff(dim=0).abs().sum().clamp_min(NOTHING)


def _blurred(planes: Float[Tensor, "t h w"]) -> Float[Tensor, "t h w"]:
    height, width = planes.shape[1:]
    sigma = height * BLUR_SHARE
    return _blur(height, sigma, planes) @ planes @ _blur(width, sigma, planes).mT


def _blur(size: int, sigma: float, like: Tensor) -> Float[Tensor, "n n"]:
    """The Gaussian filter of a row as a matrix: cut off after four sigma, and beyond its ends the row is mirrored."""
    reach = int(4 * sigma + 0.5)
    steps = torch.arange(-reach, reach + 1, device=like.device)
    weights = torch.exp(-(steps / sigma).square() / 2).to(like)
    places = (torch.arange(size, device=like.device)[:, None] + steps) % (2 * size)
    mirrored = torch.where(places < size, places, 2 * size - 1 - places)
    return like.new_zeros(size, size).scatter_add_(1, mirrored, (weights / weights.sum()).expand(size, -1).contiguous())
