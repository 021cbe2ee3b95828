"""Still picture reader on OpenImageIO, and on Pillow for AVIF: any format, depth and mode, as straight RGBA in sRGB."""

import math
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import OpenImageIO as oiio
import torch
from jaxtyping import Bool, Float, Float32
from numpy import ndarray
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.mesh.models.model import to_srgb
from dg4d_lib.video.downscaling import BAND_BYTES, BandDownscaler
from steps.sources.channels import find_channels
from steps.sources.color_profiles import convert_to_srgb
from steps.sources.decode_limit import DecodeLimit
from steps.sources.still_headers import read_header

LARGEST_SIDE = 2048  # pixels of a side after shrinking; no setting asks for more
SMALLEST_SIDE = 32  # pixels of the longest side; smaller pictures show nothing
MOST_ELONGATED = 16  # ratio of the longest to the shortest side
MOST_PIXELS = 120_000_000  # about 11,000 x 11,000

COPIES = 6  # copies of a band while colors are converted and multiplied by alpha
THREADS = 2  # of OpenImageIO; each has its own buffers
READ_WHOLE = (".ppm", ".pgm", ".webp", ".jxl", ".jp2")  # formats whose files OpenImageIO reads into memory
HELD_BYTES = {"webp": 6.0}  # bytes per pixel that a decoder holds, measured
PHOTOMETRIC = "tiff:PhotometricInterpretation"
TIFF_YCBCR = 6
TIFF_LAB = (8, 9, 10)  # CIE Lab, ICC Lab, ITU Lab

FLOATS = ("half", "float", "double")
HALF = 0.5  # alpha from which a pixel has a value
WINDOWED_FORMATS = ("openexr",)  # data and display windows differ; offsets of TIFF and PNG are places on a page
LINEAR_FORMATS = ("openexr", "hdr")
PREMULTIPLIED_FORMATS = ("openexr", "tiff")  # default without a declaration in the file
FAINT_ALPHA = 1e-3  # premultiplied colors are divided by no smaller alpha

AVIF_BYTES = 20  # per pixel: planes of up to 16 bits, and two 8-bit RGBA copies of Pillow's

ORIENTATION = 0x0112  # EXIF tag, in which Pillow also stores AVIF's own rotation and mirror
TRANSPOSED = (5, 6, 7, 8)  # EXIF orientations that swap rows and columns; flips follow
FLIPPED_ROWS = (3, 4, 7, 8)
FLIPPED_COLUMNS = (2, 3, 6, 7)


class StillPicture(NamedTuple):
    """A decoded picture.

    Attributes:
        pixels: straight sRGB and alpha in [0, 1], upright.
        has_alpha: True if the file has an alpha channel.
        size: width and height of the upright file, before shrinking.
        notes: sentences for the report about layers and colors.
    """

    pixels: Float[Tensor, "h w 4"]
    has_alpha: bool
    size: tuple[int, int]
    notes: tuple[str, ...] = ()


def check_size(width: int, height: int, what: str) -> None:
    """Refuse a picture that is too small, too elongated or too large, by its header.

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


def read_still(path: Path, what: str, limit: DecodeLimit, longest: int = LARGEST_SIDE) -> StillPicture:
    """Decode a picture in bands of rows, shrunk so that no side is longer than `longest`.

    Args:
        path: file with the suffix of its format.
        what: name of the picture in messages.
        limit: memory limit.
        longest: pixels.

    Raises:
        BadInput: the file cannot be read, or its size is out of range.
    """
    if path.suffix == ".avif":
        return _read_avif(path, what, limit, longest)
    file, held = _open(path, what, limit)
    try:
        spec = file.spec()
        _check_kind(file, what)
        still = _Still(file, what)
        still.require_memory(limit, held)
        shrinker = BandDownscaler(still.height, still.width, longest)
        for top, band in still.bands():
            shrinker.add(top, torch.from_numpy(band))
    finally:
        file.close()
    picture, profile = shrinker.picture(), spec.getattribute("ICCProfile")
    is_profile = isinstance(profile, ndarray) and not still.is_linear  # a comment of a file may have this name, too
    notes = convert_to_srgb(picture, profile.tobytes()) if is_profile else ()
    orientation = int(spec.get_int_attribute("Orientation", 1))
    return _upright(picture, still.has_alpha, orientation, (still.width, still.height), (*still.notes, *notes))


class StillValues(NamedTuple):
    """Values of one channel of a picture, not as colors.

    Attributes:
        values: as stored; integers in [0, 1] of their range.
        known: pixels that are finite, not transparent, and in the data window.
        is_float: True if the file holds floating-point numbers.
        tint: mean difference of the color channels, where known.
        size: width and height of the upright file.
    """

    values: Float32[ndarray, "h w"]
    known: Bool[ndarray, "h w"]
    is_float: bool
    tint: float
    size: tuple[int, int]


def read_values(path: Path, what: str, limit: DecodeLimit, height: int, width: int) -> StillValues:
    """Decode a gray picture as numbers: the nearest pixels of a grid, as edges of depth must not be mixed.

    Args:
        path: file with the suffix of its format.
        what: name of the picture in messages.
        limit: memory limit.
        height: of the grid over the upright picture.
        width: likewise.

    Raises:
        BadInput: the file cannot be read, or its size is out of range.
    """
    if path.suffix == ".avif":
        raise BadInput(f"{what} is an AVIF, which is read as colors alone; give PNG, TIFF or EXR")
    file, held = _open(path, what, limit)
    try:
        spec = file.spec()
        _check_kind(file, what)
        still = _Still(file, what, depth=True)
        still.require_memory(limit, held)
        orientation = int(spec.get_int_attribute("Orientation", 1))
        if orientation in TRANSPOSED:
            height, width = width, height
        rows, columns = _nearest(height, still.height), _nearest(width, still.width)
        picked = np.concatenate([band[:, columns][_within(rows, top, len(band))] for top, band in still.value_bands()])
    finally:
        file.close()
    size = (still.width, still.height)
    if orientation in TRANSPOSED:
        picked, size = picked.transpose(1, 0, 2), (size[1], size[0])
    flipped = [axis for axis, values in enumerate((FLIPPED_ROWS, FLIPPED_COLUMNS)) if orientation in values]
    picked = np.flip(picked, tuple(flipped))
    colors, alpha = picked[..., :3], picked[..., 3]
    known = np.isfinite(colors).all(-1) & (alpha > HALF)
    tint = float(np.ptp(colors[known], -1).mean()) if known.any() else 0.0
    values = np.where(known, colors[..., 0], 0).astype(np.float32)
    return StillValues(values, known, str(spec.format) in FLOATS, tint, size)


def _check_kind(file: oiio.ImageInput, what: str) -> None:
    """Refuse sizes out of range, deep pictures, volumes and Lab colors, which libtiff converts with a yellow cast."""
    spec = file.spec()
    check_size(*_display_window(file)[2:], what)
    if spec.width * spec.height > MOST_PIXELS:
        raise BadInput(
            f"{what} stores {spec.width} x {spec.height} pixels in its data window; at most "
            f"{MOST_PIXELS // 1_000_000} million are read: crop the data window to the display window"
        )
    if spec.deep or spec.depth > 1:
        kind = "has several samples per pixel (deep data)" if spec.deep else "is a volume of several slices"
        raise BadInput(f"{what} {kind}, which cannot be read here; export it flattened, as PNG or EXR")
    if file.format_name() == "tiff" and spec.get_int_attribute(PHOTOMETRIC, 0) in TIFF_LAB:
        raise BadInput(f"{what} is a TIFF with Lab colors, which cannot be read here; export it with RGB colors")


def _display_window(file: oiio.ImageInput) -> tuple[int, int, int, int]:
    """Return first column and row, width and height of the display window; only OpenEXR has one beside its data."""
    spec = file.spec()
    if file.format_name() in WINDOWED_FORMATS:
        return spec.full_x, spec.full_y, spec.full_width, spec.full_height
    return spec.x, spec.y, spec.width, spec.height


def _nearest(count: int, length: int) -> ndarray:
    """Return the pixels of a side that lie nearest to the centers of `count` even parts."""
    return ((np.arange(count) + 0.5) * length / count).astype(np.int64)


def _within(rows: ndarray, top: int, count: int) -> ndarray:
    """Return those of ascending rows that lie in a band, counted from its first row."""
    return rows[(rows >= top) & (rows < top + count)] - top


def _read_avif(path: Path, what: str, limit: DecodeLimit, longest: int) -> StillPicture:
    """Decode an AVIF with Pillow, as OpenImageIO's wheel has no reader."""
    try:
        with warnings.catch_warnings(), Image.open(path, formats=["AVIF"]) as image:
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            width, height = image.size
            check_size(width, height, what)
            limit.require(AVIF_BYTES * width * height, what, width, height)
            shrinker, rows = BandDownscaler(height, width, longest), max(1, BAND_BYTES // (16 * width))
            for top in range(0, height, rows):
                band = image.crop((0, top, width, min(height, top + rows))).convert("RGBA")
                shrinker.add(top, torch.from_numpy(np.array(band)).float() / 255)
            picture = shrinker.picture()
            notes = convert_to_srgb(picture, image.info.get("icc_profile") or b"")
            has_alpha, orientation = image.mode.endswith("A"), image.getexif().get(ORIENTATION, 1)
            return _upright(picture, has_alpha, orientation, image.size, notes)
    except (UnidentifiedImageError, Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
        raise BadInput(f"{what} is a broken or too large AVIF; export it as PNG or JPEG") from error


def _upright(
    pixels: Float[Tensor, "h w 4"], has_alpha: bool, orientation: int, size: tuple[int, int], notes: tuple[str, ...]
) -> StillPicture:
    """Undo EXIF's orientation, 1 to 8; other values mean 1."""
    if orientation in TRANSPOSED:
        pixels, size = pixels.transpose(0, 1), (size[1], size[0])
    flipped = [axis for axis, values in enumerate((FLIPPED_ROWS, FLIPPED_COLUMNS)) if orientation in values]
    return StillPicture(pixels.flip(flipped).contiguous(), has_alpha, size, notes)


def _open(path: Path, what: str, limit: DecodeLimit) -> tuple[oiio.ImageInput, float]:
    """Open a picture within the memory limit; return it and the bytes per pixel that its decoder holds."""
    header = read_header(path, path.suffix)
    if header:
        check_size(header.width, header.height, what)
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
    return file, header.held if header else 0.0


class _Still:
    """An open picture, read in bands of rows.

    Attributes:
        width: of the display window in pixels, not yet upright.
        height: likewise.
        has_alpha: True if the file has an alpha channel.
        is_linear: True if it holds linear light.
        notes: a sentence about the layer.
    """

    def __init__(self, file: oiio.ImageInput, what: str, depth: bool = False) -> None:
        """Find the channels; with `depth` one that is named so goes before colors."""
        self._file, self._what, self._spec = file, what, file.spec()
        left, top, self.width, self.height = _display_window(file)
        self._left, self._top = self._spec.x - left, self._spec.y - top  # of the data window in it
        self._channels, self.has_alpha, self.notes = find_channels(self._spec, depth)
        self.is_linear = file.format_name() in LINEAR_FORMATS or str(self._spec.format) in FLOATS
        self._is_premultiplied = (
            self.has_alpha
            and file.format_name() in PREMULTIPLIED_FORMATS
            and not self._spec.get_int_attribute("oiio:UnassociatedAlpha")
        )
        self._first, self._last = min(self._channels), max(self._channels) + 1
        self._rows = self._rows_at_once()

    def bands(self) -> Iterator[tuple[int, Float[ndarray, "rows w 4"]]]:
        """Yield the first row of every band, and its straight sRGB and alpha in [0, 1]; black outside the data.

        Raises:
            BadInput: the file is cut off or broken.
        """
        for top, pixels in self._displayed(outside=0.0):
            picture = _as_rgba(pixels, [channel - self._first for channel in self._channels])
            if self._is_premultiplied:
                picture[..., :3] /= np.maximum(picture[..., 3:], FAINT_ALPHA)
            if self.is_linear:
                picture[..., :3] = to_srgb(picture[..., :3])
            yield top, picture.clip(0, 1)

    def value_bands(self) -> Iterator[tuple[int, Float[ndarray, "rows w 4"]]]:
        """Yield the first row of every band, and three channels and alpha as they are stored; NaN outside the data.

        Raises:
            BadInput: the file is cut off or broken.
        """
        for top, pixels in self._displayed(outside=np.nan):
            picked = [channel - self._first for channel in self._channels]
            yield top, np.concatenate([pixels[..., picked], np.ones((*pixels.shape[:2], 4 - len(picked)))], -1)

    def _displayed(self, outside: float) -> Iterator[tuple[int, Float[ndarray, "rows w c"]]]:
        """Yield bands of the display window, each with its first row; pixels beside the data window are `outside`."""
        done = 0
        for top in range(0, self._spec.height, self._rows):
            rows, offset = min(self._rows, self._spec.height - top), self._top + top
            first, last = max(0, offset), min(self.height, offset + rows)
            if first < last:
                yield from self._empty_rows(done, first, outside)
                yield first, self._fit_columns(self._pixels(top, rows)[first - offset : last - offset], outside)
                done = last
        yield from self._empty_rows(done, self.height, outside)

    def _empty_rows(self, first: int, last: int, outside: float) -> Iterator[tuple[int, Float[ndarray, "rows w c"]]]:
        """Yield bands of rows above or below the data window."""
        for top in range(first, last, self._rows):
            yield top, np.full((min(self._rows, last - top), self.width, self._last - self._first), outside, np.float32)

    def _fit_columns(self, pixels: Float[ndarray, "rows data_w c"], outside: float) -> Float[ndarray, "rows w c"]:
        """Crop and pad rows of the data window to the width of the display window."""
        if (self._left, pixels.shape[1]) == (0, self.width):
            return pixels
        fitted = np.full((len(pixels), self.width, pixels.shape[2]), outside, np.float32)
        first, last = max(0, self._left), min(self.width, self._left + pixels.shape[1])
        if first < last:
            fitted[:, first:last] = pixels[:, first - self._left : last - self._left]
        return fitted

    def _rows_at_once(self) -> int:
        """Return the height of a band: whole tiles, or whole compressed blocks if they are small enough."""
        spec = self._spec
        if spec.tile_width:
            return int(spec.tile_height)
        widest = max(self.width, spec.width)
        rows = max(1, BAND_BYTES // (4 * widest * (self._last - self._first)))
        block = spec.get_int_attribute("oiio:RowsPerChunk", 1)
        if self._file.format_name() == "openexr" or block * widest * spec.pixel_bytes(True) <= BAND_BYTES:
            rows = -(-rows // block) * block
        return min(rows, max(self.height, spec.height))

    def require_memory(self, limit: DecodeLimit, held: float) -> None:
        """Refuse a picture that takes too much memory; the message has the size of its larger window.

        Args:
            limit: memory that is allowed.
            held: bytes per pixel that the decoder holds, as far as the header tells.
        """
        windows = (self.width, self.height), (self._spec.width, self._spec.height)
        limit.require(self.needed_bytes(held), self._what, *max(windows, key=math.prod))

    def needed_bytes(self, held: float) -> float:
        """Return an estimate of the memory of the decoder, a band, its copies and the result.

        Args:
            held: bytes per pixel that the decoder holds, as far as the header tells.
        """
        spec, pixels = self._spec, self.width * self.height
        band = self._rows * max(self.width, spec.width, -(-spec.width // max(1, spec.tile_width)) * spec.tile_width)
        native = spec.pixel_bytes(True)
        held = max(held, HELD_BYTES.get(self._file.format_name(), 0.0))
        if spec.get_int_attribute(PHOTOMETRIC, 0) == TIFF_YCBCR:
            held = max(held, 4.0)  # libtiff converts the whole picture to 8-bit RGBA
        work = band * (2 * native + 4 * (self._last - self._first) + COPIES * 16)
        return held * spec.width * spec.height + work + 16 * min(pixels, LARGEST_SIDE**2)

    def _pixels(self, top: int, rows: int) -> Float[ndarray, "rows data_w c"]:
        """Read a band of the data window, with the channels that are needed."""
        spec, begin = self._spec, self._spec.y + top
        channels = (self._first, self._last)
        if spec.tile_width:
            across = (spec.x, spec.x + spec.width, begin, begin + rows)
            pixels = self._file.read_tiles(0, 0, *across, spec.z, spec.z + 1, *channels, "float")
        else:
            pixels = self._file.read_scanlines(0, 0, begin, begin + rows, spec.z, *channels, "float")
        reason = self._file.geterror()
        if pixels is None or "remature end" in reason:
            raise BadInput(f"{self._what} is cut off or broken: {_reason(reason)}; copy or export it again")
        return np.asarray(pixels, np.float32).reshape(rows, spec.width, -1)


def _as_rgba(pixels: Float[ndarray, "h w c"], channels: list[int]) -> Float[ndarray, "h w 4"]:
    """Pick red, green, blue and alpha, if present; NaN becomes black."""
    picture = np.ones((*pixels.shape[:2], 4), np.float32)
    for place, channel in enumerate(channels):
        picture[..., place] = pixels[..., channel]
    if not np.isfinite(picture).all():
        np.nan_to_num(picture, copy=False, nan=0.0, posinf=1.0, neginf=0.0)
    return picture


def _reason(message: str) -> str:
    """Return the first line of a decoder's message, without the path of our temporary file."""
    lines = [line.split(' ("')[0].strip() for line in message.splitlines() if line.strip()]
    return lines[0] if lines and "/" not in lines[0] else "the data do not follow the format"
