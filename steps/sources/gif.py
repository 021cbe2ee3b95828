"""Frames of GIF files, by their blocks: FFmpeg fills missing pixels of a truncated file without an error."""

from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from dg4d_lib.errors import BadInput

SCREEN_BYTES = 13  # signature, version and logical screen descriptor
IMAGE_BYTES = 9  # image descriptor after its separator
SCREEN_FLAGS, IMAGE_FLAGS = 10, 8  # offsets of the flags in the two descriptors
EXTENSION, IMAGE = b"!", b","


def check_first_frame(path: Path) -> None:
    """Refuse a GIF that ends within its first frame; other damage is left to the decoder.

    Raises:
        BadInput: the file is cut off.
    """
    try:
        with path.open("rb") as file:
            _skip_screen(file)
            _skip_frame(file)
    except EOFError as error:
        raise BadInput(
            "the GIF is cut off or broken: it ends within its first frame; copy or export it again"
        ) from error


def has_two_frames(path: Path) -> bool:
    """Return True for a GIF with two whole frames or more."""
    with suppress(EOFError), path.open("rb") as file:
        _skip_screen(file)
        return _skip_frame(file) and _skip_frame(file)
    return False


def _skip_screen(file: BinaryIO) -> None:
    _skip_palette(file, _read(file, SCREEN_BYTES)[SCREEN_FLAGS])


def _skip_frame(file: BinaryIO) -> bool:
    """Read to the end of the next frame, or of the block in its place; return True if it is a frame."""
    while (block := _read(file, 1)) == EXTENSION:
        _read(file, 1)
        _skip_data(file)
    if block == IMAGE:
        _skip_palette(file, _read(file, IMAGE_BYTES)[IMAGE_FLAGS])
        _read(file, 1)  # LZW code size
        _skip_data(file)
    return block == IMAGE


def _skip_palette(file: BinaryIO, flags: int) -> None:
    if flags & 0x80:
        _read(file, 3 << (1 + (flags & 7)))


def _skip_data(file: BinaryIO) -> None:
    """Read sub-blocks of up to 255 bytes until the empty one."""
    while size := _read(file, 1)[0]:
        _read(file, size)


def _read(file: BinaryIO, count: int) -> bytes:
    content = file.read(count)
    if len(content) < count:
        raise EOFError
    return content
