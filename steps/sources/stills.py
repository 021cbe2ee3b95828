"""Still pictures of users: any format, depth and mode that OpenImageIO reads, as straight RGBA in sRGB."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.video.downscaling import BAND_BYTES, BandDownscaler
from steps.sources.decode_limit import DecodeLimit
from steps.sources.still_headers import read_header

LARGEST_SIDE = 2048  # pixels that are worked on; larger pictures are shrunk, no setting asks for more
SMALLEST_SIDE = 32  # pixels of the longest side; below there is nothing to see
MOST_ELONGATED = 16  # longest to shortest side
MOST_PIXELS = 120_000_000  # about 11,000 x 11,000; refused before anything is decoded

COPIES = 6  # of a band while colors are converted and multiplied by alpha
THREADS = 2  # of OpenImageIO: each has buffers of its own
READ_WHOLE = (".ppm", ".pgm", ".webp", ".jxl", ".jp2")  # formats whose files OpenImageIO reads into memory
HELD_BYTES = {"webp": 6.0}  # per pixel that a decoder keeps; libwebp: measured
TIFF_CONVERTED = (6, 8, 9, 10)  # photometric interpretations: YCbCr, CIE Lab, ICC Lab, ITU Lab

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


def read_still(
    path: Path, what: str, limit: DecodeLimit, longest: int = LARGEST_SIDE
) -> tuple[Float[Tensor, "h w 4"], bool, tuple[int, int]]:
    """Decode a picture, shrunk on the way so that no side is longer than `longest`.

    Args:
        path: the file; its suffix must tell the format.
        what: name of the picture in messages.
        limit: for the memory.
        longest: pixels.

    Returns:
        Straight sRGB and alpha in [0, 1], upright; whether the file has alpha; and its own width and height.

    Raises:
        BadInput: it cannot be read, or its size is out of range.
    """
    with open_still(path, what, limit) as still:
        shrinker = BandDownscaler(still.height, still.width, longest)
        for top, band in still.bands():
            shrinker.add(top, torch.from_numpy(band))
    picture = upright(shrinker.picture(), still.orientation)
    return picture, still.has_alpha, upright_size(still.width, still.height, still.orientation)


def upright(picture: Float[Tensor, "h w 4"], orientation: int) -> Float[Tensor, "h2 w2 4"]:
    """Undo EXIF's orientation; one that does not exist is 1."""
    transpose, flip_rows, flip_columns = ORIENTATIONS.get(orientation, ORIENTATIONS[1])
    picture = picture.transpose(0, 1) if transpose else picture
    flipped = [axis for axis, flip in enumerate((flip_rows, flip_columns)) if flip]
    return picture.flip(flipped).contiguous()


def upright_size(width: int, height: int, orientation: int) -> tuple[int, int]:
    """Return width and height after `upright`."""
    return (height, width) if ORIENTATIONS.get(orientation, ORIENTATIONS[1])[0] else (width, height)


@contextmanager
def open_still(path: Path, what: str, limit: DecodeLimit, sized: bool = True) -> Iterator["Still"]:
    """Open a picture while the block runs; with `sized`, its size is checked.

    Raises:
        BadInput: it cannot be read, or its size is out of range.
    """
    header = read_header(path, path.suffix)
    if header and sized:
        check_size(header.width, header.height, what)
    if header:
        limit.require(header.width * header.height * header.held, what, header.width, header.height)
    if path.suffix in READ_WHOLE:
        limit.require_file(path, what)
    oiio.attribute("threads", THREADS)
    oiio.attribute("exr_threads", THREADS)
    oiio.attribute("try_all_readers", 0)
    request = oiio.ImageSpec()
    request.attribute("oiio:UnassociatedAlpha", 1)
    file = oiio.ImageInput.open(str(path), request)
    if file is None:
        raise BadInput(f"{what} cannot be read as a picture: {_reason(oiio.geterror())}; export it again as PNG")
    try:
        spec = file.spec()
        if sized:
            check_size(spec.width, spec.height, what)
        if spec.deep or spec.depth > 1:
            kind = "has several samples per pixel (deep data)" if spec.deep else "is a volume of several slices"
            raise BadInput(f"{what} {kind}, which cannot be read here; export it flattened, as PNG or EXR")
        still = Still(file, what, header.held if header else 0.0)
        limit.require(still.needed_bytes, what, spec.width, spec.height)
        yield still
    finally:
        file.close()


class Still:
    """An open picture, read in bands of rows.

    Attributes:
        width: pixels, as stored.
        height: pixels, as stored.
        has_alpha: true if the file has an alpha channel.
        needed_bytes: estimate of the memory for decoding it.
    """

    def __init__(self, file: oiio.ImageInput, what: str, held: float) -> None:
        self._file, self._what, self._spec = file, what, file.spec()
        self.width, self.height = self._spec.width, self._spec.height
        self._colors, self._alpha = _channels(self._spec)
        self.has_alpha = self._alpha >= 0
        used = [*self._colors, *([self._alpha] if self.has_alpha else [])]
        self._first, self._last = min(used), max(used) + 1
        self._rows = self._rows_at_once()
        self.needed_bytes = self._estimate(held)

    def bands(self) -> Iterator[tuple[int, Float[ndarray, "rows w 4"]]]:
        """Yield the first row of every band, and its straight sRGB and alpha in [0, 1].

        Raises:
            BadInput: the file is cut off or broken.
        """
        for top in range(0, self.height, self._rows):
            rows = min(self._rows, self.height - top)
            picture = _as_rgba(self._pixels(top, rows), [i - self._first for i in self._colors], self._alpha_read)
            if self._is_linear():
                if self.has_alpha:
                    picture[..., :3] /= np.maximum(picture[..., 3:], FAINT_ALPHA)
                picture[..., :3] = _srgb(picture[..., :3])
            yield top, picture.clip(0, 1)

    @property
    def orientation(self) -> int:
        """EXIF's orientation, 1 to 8 where the file follows the standard."""
        return int(self._spec.get_int_attribute("Orientation", 1))

    @property
    def _alpha_read(self) -> int:
        return self._alpha - self._first if self.has_alpha else -1

    def _is_linear(self) -> bool:
        return self._file.format_name() in LINEAR_FORMATS or str(self._spec.format) in ("half", "float", "double")

    def _rows_at_once(self) -> int:
        """Return the height of a band: whole tiles, and whole compressed blocks where they are not too large."""
        spec = self._spec
        if spec.tile_width:
            return int(spec.tile_height)
        rows = max(1, BAND_BYTES // (4 * self.width * (self._last - self._first)))
        block = spec.get_int_attribute("oiio:RowsPerChunk", 1)
        if self._file.format_name() == "openexr" or block * self.width * spec.pixel_bytes(True) <= BAND_BYTES:
            rows = -(-rows // block) * block
        return min(rows, self.height)

    def _estimate(self, held: float) -> float:
        """Return the bytes of the decoder, of the band being read, of its copies, and of the result."""
        spec, pixels = self._spec, self.width * self.height
        band = self._rows * max(self.width, -(-self.width // max(1, spec.tile_width)) * spec.tile_width)
        native = spec.pixel_bytes(True)
        held = max(held, HELD_BYTES.get(self._file.format_name(), 0.0), self._rgba_of_tiff())
        work = band * (2 * native + 4 * (self._last - self._first) + COPIES * 16)
        return held * pixels + work + 16 * min(pixels, LARGEST_SIDE**2)

    def _rgba_of_tiff(self) -> float:
        """Return the bytes per pixel of TIFFs that libtiff converts as a whole: YCbCr, CIE Lab and the like."""
        photometric = self._spec.get_int_attribute("tiff:PhotometricInterpretation", 0)
        return 4.0 if photometric in TIFF_CONVERTED else 0.0

    def _pixels(self, top: int, rows: int) -> Float[ndarray, "rows w c"]:
        spec, begin = self._spec, self._spec.y + top
        channels = (self._first, self._last)
        if spec.tile_width:
            across = (spec.x, spec.x + self.width, begin, begin + rows)
            pixels = self._file.read_tiles(0, 0, *across, spec.z, spec.z + 1, *channels, "float")
        else:
            pixels = self._file.read_scanlines(0, 0, begin, begin + rows, spec.z, *channels, "float")
        reason = self._file.geterror()
        if pixels is None or "remature end" in reason:
            raise BadInput(f"{self._what} is cut off or broken: {_reason(reason)}; copy or export it again")
        return np.asarray(pixels, np.float32).reshape(rows, self.width, -1)


def _channels(spec: oiio.ImageSpec) -> tuple[list[int], int]:
    """Find red, green, blue, and alpha or -1; gray is repeated, depth and the like are ignored."""
    names = [name.lower() for name in spec.channelnames]
    alpha = spec.alpha_channel if spec.alpha_channel >= 0 else names.index("a") if "a" in names else -1
    if all(name in names for name in "rgb"):
        return [names.index(name) for name in "rgb"], alpha
    rest = [i for i in range(len(names)) if i != alpha] or [0]
    return (rest[:3] if len(rest) >= 3 else rest[:1] * 3), alpha


def _as_rgba(pixels: Float[ndarray, "h w c"], colors: list[int], alpha: int) -> Float[ndarray, "h w 4"]:
    """Pick red, green, blue and alpha; what is not a number is black."""
    picture = np.ones((*pixels.shape[:2], 4), np.float32)
    for place, channel in enumerate([*colors, alpha] if alpha >= 0 else colors):
        picture[..., place] = pixels[..., channel]
    if not np.isfinite(picture).all():
        np.nan_to_num(picture, copy=False, nan=0.0, posinf=1.0, neginf=0.0)
    return picture


def _srgb(linear: np.ndarray) -> np.ndarray:
    """Apply the sRGB transfer function (IEC 61966-2-1); what is brighter than white is white."""
    linear = linear.clip(0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def _reason(message: str) -> str:
    """Shorten a decoder's message to one line, without the path of our scratch file."""
    lines = [line.split(' ("')[0].strip() for line in message.splitlines() if line.strip()]
    return lines[0] if lines and "/" not in lines[0] else "the data do not follow the format"
