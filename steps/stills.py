"""Still pictures of users: any format, depth and mode that OpenImageIO reads, as straight RGBA in sRGB."""

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.video.framing import shrink

LARGEST_SIDE = 2048  # pixels that are worked on; larger pictures are shrunk, no setting asks for more
SMALLEST_SIDE = 32  # pixels of the longest side; below there is nothing to see
MOST_ELONGATED = 16  # longest to shortest side
MOST_PIXELS = 120_000_000  # about 11,000 x 11,000; refused before anything is decoded

LINEAR_FORMATS = ("openexr", "hdr")
FAINT_ALPHA = 1e-3  # alpha below this has no color of its own when it was multiplied into it

# What EXIF's orientation 1 to 8 asks for: transpose first, then flip rows, then flip columns.
ORIENTATIONS = {
    1: (False, False, False),
    2: (False, False, True),
    3: (False, True, True),
    4: (False, True, False),
    5: (True, False, False),
    6: (True, False, True),
    7: (True, True, True),
    8: (True, True, False),
}


def check_size(width: int, height: int, what: str) -> None:
    """Refuse what is too small, too long or too large, from the header alone.

    Raises:
        BadInput: says the size, what is allowed and what to do.
    """
    if width < 1 or height < 1:
        raise BadInput(f"{what} says that it is {width} x {height} pixels; it is broken, export it again")
    if max(width, height) < SMALLEST_SIDE:
        raise BadInput(
            f"{what} is {width} x {height} pixels; its longest side must have at least {SMALLEST_SIDE}: "
            "give the original instead of a thumbnail"
        )
    if max(width, height) > MOST_ELONGATED * min(width, height):
        raise BadInput(
            f"{what} is {width} x {height} pixels; the longest side may be at most {MOST_ELONGATED} times the "
            "shortest: crop it to the subject"
        )
    if width * height > MOST_PIXELS:
        raise BadInput(
            f"{what} is {width} x {height} pixels; at most {MOST_PIXELS // 1_000_000} million are read: shrink it first"
        )


def read_still(path: Path, what: str) -> tuple[Float[Tensor, "h w 4"], bool]:
    """Decode a picture of a user, no side longer than `LARGEST_SIDE`; else like `decode_still`."""
    picture, has_alpha = decode_still(path, what)
    return shrink(picture[None], LARGEST_SIDE)[0], has_alpha


def decode_still(path: Path, what: str, limits: bool = True) -> tuple[Float[Tensor, "h w 4"], bool]:
    """Decode a picture.

    Args:
        path: the file; its suffix must tell the format.
        what: how messages call it.
        limits: whether its size is checked.

    Returns:
        Straight sRGB and alpha in [0, 1], upright; and whether the file has alpha.

    Raises:
        BadInput: it cannot be read, or its size is out of range.
    """
    request = oiio.ImageSpec()
    request.attribute("oiio:UnassociatedAlpha", 1)
    file = oiio.ImageInput.open(str(path), request)
    if file is None:
        raise BadInput(f"{what} cannot be read as a picture: {_reason(oiio.geterror())}; export it again as PNG")
    try:
        spec = file.spec()
        if limits:
            check_size(spec.width, spec.height, what)
        pixels = file.read_image(0, 0, 0, spec.nchannels, "float")
        reason = file.geterror()
        if pixels is None or "remature end" in reason:
            raise BadInput(f"{what} is cut off or broken: {_reason(reason)}; copy or export it again")
        picture, has_alpha = _as_rgba(np.asarray(pixels, np.float32).reshape(spec.height, spec.width, -1), spec)
        if file.format_name() in LINEAR_FORMATS or str(spec.format) in ("half", "float", "double"):
            if has_alpha:
                picture[..., :3] /= np.maximum(picture[..., 3:], FAINT_ALPHA)
            picture[..., :3] = _srgb(picture[..., :3])
    finally:
        file.close()
    transpose, flip_rows, flip_columns = ORIENTATIONS.get(spec.get_int_attribute("Orientation", 1), ORIENTATIONS[1])
    picture = picture.transpose(1, 0, 2) if transpose else picture
    picture = picture[:: -1 if flip_rows else 1, :: -1 if flip_columns else 1]
    return torch.from_numpy(np.ascontiguousarray(picture.clip(0, 1))), has_alpha


def _as_rgba(pixels: np.ndarray, spec: oiio.ImageSpec) -> tuple[np.ndarray, bool]:
    """Red, green, blue and alpha out of whatever channels a file has; gray is repeated, depth and the like dropped."""
    names = [name.lower() for name in spec.channelnames]
    alpha = spec.alpha_channel if spec.alpha_channel >= 0 else names.index("a") if "a" in names else -1
    if all(name in names for name in "rgb"):
        chosen = [names.index(name) for name in "rgb"]
    else:
        rest = [i for i in range(len(names)) if i != alpha] or [0]
        chosen = rest[:3] if len(rest) >= 3 else rest[:1] * 3
    finite = np.nan_to_num(pixels, nan=0.0, posinf=1.0, neginf=0.0)
    opacity = finite[..., alpha] if alpha >= 0 else np.ones(finite.shape[:2], np.float32)
    return np.dstack([finite[..., chosen], opacity]), alpha >= 0


def _srgb(linear: np.ndarray) -> np.ndarray:
    """The sRGB transfer function (IEC 61966-2-1); what is brighter than white is white."""
    linear = linear.clip(0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def _reason(message: str) -> str:
    """A decoder's message on one line, without the path of our scratch file."""
    lines = [line.split(' ("')[0].strip() for line in message.splitlines() if line.strip()]
    return lines[0] if lines and "/" not in lines[0] else "the data do not follow the format"
