"""AVIF reader on Pillow, as OpenImageIO's wheel has none."""

import warnings
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.video.shrinking import BAND_BYTES, BandShrinker
from steps.sources.decode_limit import DecodeLimit
from steps.sources.stills import LARGEST_SIDE, check_size, upright, upright_size

DECODED_BYTES = 20  # per pixel: planes of up to 16 bits, and two 8-bit RGBA copies of Pillow's
ORIENTATION = 0x0112  # EXIF tag, in which Pillow also stores AVIF's own rotation and mirror


def read_avif(
    path: Path, what: str, limit: DecodeLimit, longest: int = LARGEST_SIDE
) -> tuple[Float[Tensor, "h w 4"], bool, tuple[int, int]]:
    """Decode a picture as `stills.read_still` does.

    Raises:
        BadInput: it cannot be read, or its size is out of range.
    """
    try:
        with warnings.catch_warnings(), Image.open(path, formats=["AVIF"]) as image:
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            width, height = image.size
            check_size(width, height, what)
            limit.require(DECODED_BYTES * width * height, what, width, height)
            has_alpha, orientation = image.mode.endswith("A"), image.getexif().get(ORIENTATION, 1)
            shrunk = _in_bands(image, longest)
            return upright(shrunk, orientation), has_alpha, upright_size(width, height, orientation)
    except (UnidentifiedImageError, Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
        raise BadInput(f"{what} is a broken or too large AVIF; export it as PNG or JPEG") from error


def _in_bands(image: Image.Image, longest: int) -> Float[Tensor, "h2 w2 4"]:
    """Decode and shrink a picture in bands of rows, which bounds the float copies in memory."""
    width, height = image.size
    shrinker, rows = BandShrinker(height, width, longest), max(1, BAND_BYTES // (16 * width))
    for top in range(0, height, rows):
        band = image.crop((0, top, width, min(height, top + rows))).convert("RGBA")
        shrinker.add(top, torch.from_numpy(np.array(band)).float() / 255)
    return shrinker.picture()
