"""How alike pictures are, one number per picture of a batch."""

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.images import resize

BEST_PSNR = 60.0  # dB; equal pictures have this instead of infinity, so that means stay finite


def psnr(
    images: Float[Tensor, "b h w c"],
    truth: Float[Tensor, "b h w c"],
    region: Float[Tensor, "b h w 1"] | None = None,
) -> Float[Tensor, " b"]:
    """Peak signal-to-noise ratio of pictures in [0, 1], in dB, at most 60.

    Args:
        images: what is judged.
        truth: what it should be.
        region: weights of the pixels, for example the union of two silhouettes; None is the whole picture. A picture
            whose region is empty has nothing to be wrong about: 60.
    """
    error = (images - truth).square().mean(-1, keepdim=True)
    weight = torch.ones_like(error) if region is None else region.to(error)
    mean = (error * weight).sum((1, 2, 3)) / weight.sum((1, 2, 3)).clamp_min(torch.finfo(error.dtype).tiny)
    return -10 * mean.clamp_min(10 ** (-BEST_PSNR / 10)).log10()


def iou(
    coverage: Float[Tensor, "b h w 1"], truth: Float[Tensor, "b h w 1"], threshold: float = 0.5
) -> Float[Tensor, " b"]:
    """Intersection over union of two silhouettes: the pixels with coverage above the threshold. Two empty ones: 1."""
    ours, theirs = coverage > threshold, truth > threshold
    both, either = (ours & theirs).sum((1, 2, 3)), (ours | theirs).sum((1, 2, 3))
    return torch.where(either > 0, both / either.clamp_min(1), 1.0).to(coverage)


def resize_square(images: Float[Tensor, "b h w c"], size: int) -> Float[Tensor, "b size size c"]:
    """Resize square images, bicubic and clamped to [0, 1], as Pillow's `resize` does."""
    return resize(images, (size, size), "bicubic").clamp(0, 1)
