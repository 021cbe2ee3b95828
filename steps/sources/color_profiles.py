"""Conversion from ICC profiles of pictures to sRGB, by Little CMS in Pillow."""

from io import BytesIO

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageCms
from torch import Tensor

LARGEST_PROFILE = 4 * 2**20  # bytes; cameras and displays have thousands, tables of scanners up to about 2 million
SAME_LEVELS = 2  # of 255; profiles that change no color by more are sRGB
ROWS = 256  # converted at once
IGNORED = "The color profile of the picture is broken or too large, and is ignored: its colors are taken as sRGB."


def convert_to_srgb(picture: Float[Tensor, "h w 4"], profile: bytes) -> tuple[str, ...]:
    """Convert colors in place, with 8 bits each; return a note if the profile cannot be used.

    Profiles of gray, CMYK and Lab do not describe RGB values and are ignored, as are those of sRGB.

    Args:
        picture: straight colors and alpha in [0, 1].
        profile: ICC profile of the file; empty without.
    """
    if not profile:
        return ()
    if len(profile) > LARGEST_PROFILE:
        return (IGNORED,)
    try:
        source = ImageCms.ImageCmsProfile(BytesIO(profile))
        if source.profile.xcolor_space != "RGB ":
            return ()
        transform = ImageCms.buildTransform(source, ImageCms.createProfile("sRGB"), "RGB", "RGB")
    except (OSError, ValueError, ImageCms.PyCMSError):  # the second: names that are not ASCII
        return (IGNORED,)
    if _is_srgb(transform):
        return ()
    for band in torch.split(picture[..., :3], ROWS):
        levels = Image.fromarray((band * 255).round().byte().numpy())
        band.copy_(torch.from_numpy(np.array(ImageCms.applyTransform(levels, transform))) / 255)
    return ()


def _is_srgb(transform: ImageCms.ImageCmsTransform) -> bool:
    """Return True if a transform to sRGB changes next to nothing."""
    levels = np.linspace(0, 255, 16).astype(np.uint8)
    grid = np.stack(np.meshgrid(levels, levels, levels), -1).reshape(16, -1, 3)
    converted = np.asarray(ImageCms.applyTransform(Image.fromarray(grid), transform))
    return bool(np.abs(converted.astype(int) - grid).max() <= SAME_LEVELS)
