"""Temporal averaging where a video stands still, so that a matte does not flicker."""

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

STILL = 0.04  # change of color, in [0, 1], at which the weight of the neighboring frame falls to 1/e
NOISE_WINDOW = 3  # pixels over which colors are averaged before they are compared, against noise


def average_still_pixels(values: Float[Tensor, "t h w"], frames: Float[Tensor, "t h w 3"]) -> Float[Tensor, "t h w"]:
    """Average a map over all frames that a pixel's color connects without a change; moving pixels keep their values.

    A recursive filter, forward and backward: the weight of another frame is the product of the weights of all steps
    between, each of which falls with the change of color.
    """
    if len(values) < 2:
        return values
    weights = torch.stack([_stillness(one, other) for one, other in pairwise(frames)])
    forward = _accumulate(values, weights)
    backward = [each.flip(0) for each in _accumulate(values.flip(0), weights.flip(0))]
    totals = forward[0] + backward[0] - values
    return totals / (forward[1] + backward[1] - 1)


def _stillness(one: Float[Tensor, "h w 3"], other: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
    change = (other - one).permute(2, 0, 1)[None]
    smooth: Tensor = avg_pool2d(change, NOISE_WINDOW, 1, NOISE_WINDOW // 2, count_include_pad=False)[0]
    return torch.exp(-(smooth.abs().amax(0) / STILL).square())


def _accumulate(
    values: Float[Tensor, "t h w"], weights: Float[Tensor, "s h w"]
) -> tuple[Float[Tensor, "t h w"], Float[Tensor, "t h w"]]:
    """Return weighted sums of all frames up to each, and the sums of their weights."""
    sums, norms = [values[0]], [torch.ones_like(values[0])]
    for value, weight in zip(values[1:], weights, strict=True):
        sums.append(value + weight * sums[-1])
        norms.append(1 + weight * norms[-1])
    return torch.stack(sums), torch.stack(norms)
