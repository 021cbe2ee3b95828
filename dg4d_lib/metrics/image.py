"""Image metrics, one value per image of a batch: PSNR and IoU."""

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.images import resize

MAX_PSNR = 60.0  # dB, instead of infinity for equal images, so that means stay finite


def psnr(
    images: Float[Tensor, "b h w c"],
    ground_truth: Float[Tensor, "b h w c"],
    region: Float[Tensor, "b h w 1"] | None = None,
) -> Float[Tensor, " b"]:
    """Return the peak signal-to-noise ratio of images in [0, 1], in dB, at most 60.

    Args:
        images: to compare.
        ground_truth: reference images.
        region: weights of the pixels, for example the union of two silhouettes; None is the whole image. An image with
            an empty region gets 60.

    Raises:
        BadInput: images of integers.
    """
    error = (as_float(images) - as_float(ground_truth)).square().mean(-1, keepdim=True)
    weight = torch.ones_like(error) if region is None else region.to(error)
    mean = (error * weight).sum((1, 2, 3)) / weight.sum((1, 2, 3)).clamp_min(torch.finfo(error.dtype).tiny)
    return -10 * mean.clamp_min(10 ** (-MAX_PSNR / 10)).log10()


def mean_of_shown(values: Float[Tensor, " b"], region: Float[Tensor, "b h w 1"]) -> Float[Tensor, ""]:
    """Return the mean over the images whose region is not empty; over all if all regions are."""
    shown = (region > 0).flatten(1).any(1)
    return values[shown].mean() if shown.any() else values.mean()


def iou(
    alpha: Float[Tensor, "b h w 1"], ground_truth: Float[Tensor, "b h w 1"], threshold: float = 0.5
) -> Float[Tensor, " b"]:
    """Return the intersection over union of silhouettes, alpha above the threshold; 1 for two empty ones."""
    ours, theirs = alpha > threshold, ground_truth > threshold
    both, either = (ours & theirs).sum((1, 2, 3)), (ours | theirs).sum((1, 2, 3))
    return torch.where(either > 0, both / either.clamp_min(1), 1.0).to(alpha)


def as_float(images: Tensor) -> Tensor:
    """Return images in at least float32: sums over pixels overflow in half precision.

    Raises:
        BadInput: images of integers.
    """
    if not images.is_floating_point():
        raise BadInput(f"metrics need floating-point images in [0, 1]; given {images.dtype}; divide uint8 by 255")
    return images.to(torch.promote_types(images.dtype, torch.float32))


def resize_square(images: Float[Tensor, "b h w c"], size: int) -> Float[Tensor, "b size size c"]:
    """Resize square images, bicubic and clamped to [0, 1], as Pillow's `resize` does."""
    return resize(images, (size, size), "bicubic").clamp(0, 1)
