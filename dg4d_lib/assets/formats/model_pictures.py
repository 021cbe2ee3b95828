"""Textures of users' models: PNG, JPEG and WebP of bounded size."""

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dg4d_lib.errors import BadInput

MAX_IMAGE_PIXELS = 8192 * 8192


def picture_type(content: bytes) -> str:
    """Return the media type of a PNG, WebP or JPEG by its first bytes; that of JPEG for others."""
    if content[:4] == b"\x89PNG":
        return "image/png"
    return "image/webp" if content[8:12] == b"WEBP" else "image/jpeg"


def decode_picture(content: bytes, name: str) -> NDArray[np.uint8]:
    """Decode a PNG, JPEG or WebP of a model as RGBA.

    Raises:
        BadInput: it cannot be decoded, or is too large.
    """
    try:
        with Image.open(io.BytesIO(content), formats=["PNG", "JPEG", "WEBP"]) as picture:
            if picture.width * picture.height > MAX_IMAGE_PIXELS:
                raise BadInput(
                    f"the texture {name!r} of the model is {picture.width} x {picture.height} pixels; at most "
                    f"{MAX_IMAGE_PIXELS} pixels are read: make it smaller"
                )
            return np.array(_in_8_bits(picture).convert("RGBA"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise BadInput(f"the texture {name!r} of the model cannot be read ({error}); save it as PNG or JPEG") from error


def _in_8_bits(picture: Image.Image) -> Image.Image:
    """Return a picture with gray of 16 bits in 8 bits; Pillow would clip it at 255."""
    if not picture.mode.startswith("I"):
        return picture
    levels = np.array(picture).astype(np.uint32)
    return Image.fromarray(((levels + 128) // 257).astype(np.uint8))
