"""Image preprocessing of CLIP's encoders."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d, interpolate, pad

from dg4d_lib.images import resize_planes

CLIP_SIZE = 224  # pixels
CLIP_MEAN, CLIP_STD = (
    (0.48145466, 0.4578275, 0.40821073),
    (0.26862954, 0.26130258, 0.27577711),
)  # of its training images


def normalize_for_clip(planes: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
    """Normalize colors in [0, 1] by the mean and standard deviation of CLIP's training images."""
    mean, std = (planes.new_tensor(values)[:, None, None] for values in (CLIP_MEAN, CLIP_STD))
    return (planes - mean) / std


def clip_pixels(images: Float[Tensor, "b h w 3"]) -> Float[Tensor, "b 3 224 224"]:
    """Resize and normalize images in [0, 1] as CLIP's own preprocessing does."""
    planes = resize_planes(images.permute(0, 3, 1, 2), (CLIP_SIZE, CLIP_SIZE), "bicubic")
    return normalize_for_clip(planes.clamp(0, 1))


def svd_clip_pixels(images: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 s s"]:
    """Blur, resize and normalize images in [-1, 1] as Stable Video Diffusion does.

    The blur has sigma (scale - 1) / 2 for a downscaling by `scale` and is truncated at two sigma; resampling is bicubic
    with aligned corners.
    """
    for axis in (3, 2):
        images = _blur(images, axis)
    small = interpolate(images, (CLIP_SIZE, CLIP_SIZE), mode="bicubic", align_corners=True)
    return normalize_for_clip(small / 2 + 0.5)


def _blur(images: Float[Tensor, "b 3 h w"], axis: int) -> Float[Tensor, "b 3 h w"]:
    sigma = max((images.shape[axis] / CLIP_SIZE - 1) / 2, 0.001)
    length = max(int(4 * sigma), 3) | 1
    offsets = torch.arange(length, device=images.device, dtype=images.dtype) - length // 2
    weights = torch.exp(-offsets.square() / (2 * sigma**2))
    weights = (weights / weights.sum()).view((1, 1, -1, 1) if axis == 2 else (1, 1, 1, -1)).expand(3, 1, -1, -1)
    margin = length // 2
    padding = (0, 0, margin, margin) if axis == 2 else (margin, margin, 0, 0)
    return conv2d(pad(images, padding, mode="reflect"), weights, groups=3)
