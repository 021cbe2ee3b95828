"""Antialiased resizing, alpha compositing and quantization of images."""

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import interpolate

Filter = Literal["bilinear", "bicubic"]


def resize(
    images: Float[Tensor, "b h w c"], size: Sequence[int], mode: Filter = "bilinear"
) -> Float[Tensor, "b i j c"]:
    """Resize images to (height, width) with antialiasing, as Pillow's `resize`."""
    return resize_planes(images.movedim(-1, 1), size, mode).movedim(1, -1)


def resize_planes(
    planes: Float[Tensor, "b c h w"], size: Sequence[int], mode: Filter = "bilinear"
) -> Float[Tensor, "b c i j"]:
    """Resize channels-first images as `resize` does; the bicubic filter may overshoot."""
    return interpolate(planes, tuple(size), mode=mode, antialias=True, align_corners=False)


def over_background(
    color: Float[Tensor, "*b h w 3"], alpha: Float[Tensor, "*b h w 1"], background: Float[Tensor, " 3"] | float
) -> Float[Tensor, "*b h w 3"]:
    """Composite straight color over one background color."""
    return color * alpha + (1 - alpha) * background


def color_over_white(color: Float[Tensor, "*b h w 3"], alpha: Float[Tensor, "*b h w 1"]) -> Float[Tensor, "*b h w 3"]:
    """Composite straight color over white; rounds differently from `over_background`, and digests depend on it."""
    return color * alpha + 1 - alpha


def over_white(cutouts: Float[Tensor, "*b h w 4"]) -> Float[Tensor, "*b h w 3"]:
    """Composite straight cut-outs over white."""
    return color_over_white(cutouts[..., :3], cutouts[..., 3:])


def luminance(pictures: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """Return the luma of pictures (ITU-R BT.601)."""
    return pictures @ pictures.new_tensor((0.299, 0.587, 0.114))


def to_bytes(values: Float[Tensor, "*b"]) -> UInt8[Tensor, "*b"]:
    """Return the nearest of 256 levels from 0 to 1 for every value, on the CPU and without gradients."""
    return values.detach().cpu().clamp(0, 1).mul_(255).round_().to(torch.uint8)
