"""Headers of still pictures, read before a decoder opens the file and allocates memory."""

import struct
from pathlib import Path
from typing import NamedTuple

HEAD_BYTES = 2**20  # beginning of a file with its header; metadata before that are smaller
JXL_RATIOS = ((1, 1), (12, 10), (4, 3), (3, 2), (16, 9), (5, 4), (2, 1))  # width to height, ISO/IEC 18181-1
JXL_SIZE_BITS = (9, 13, 18, 30)
JPEG_STANDALONE = (0x01, *range(0xD0, 0xD9))  # markers without a length: TEM, RST0 to RST7, SOI
JPEG_FRAMES = tuple(mark for mark in range(0xC0, 0xD0) if mark not in (0xC4, 0xC8, 0xCC))  # SOF0 to SOF15
JPEG_SEQUENTIAL = (0xC0, 0xC1, 0xC9)  # frames that are decoded row by row


class Header(NamedTuple):
    """Size of a picture in pixels, and the bytes per pixel that its decoder holds until the last row is read."""

    width: int
    height: int
    held: float


def read_header(path: Path, suffix: str) -> Header | None:
    """Return the header of a JPEG, PNG, JPEG 2000 or JPEG XL; None for other formats and if it cannot be found."""
    reader = {".jpg": _jpeg, ".png": _png, ".jp2": _jpeg2000, ".jxl": _jpegxl}.get(suffix)
    if reader is None:
        return None
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    try:
        return reader(head)
    except (struct.error, IndexError):
        return None


def _png(head: bytes) -> Header | None:
    """Read IHDR, which must be the first chunk; decoders hold interlaced pictures as a whole."""
    if head[12:16] != b"IHDR":
        return None
    width, height, depth, color, interlaced = struct.unpack_from(">IIBBxxB", head, 16)
    channels = {0: 1, 2: 3, 3: 4, 4: 2}.get(color, 4)
    return Header(width, height, channels * max(1, depth // 8) if interlaced else 0)


def _jpeg(head: bytes) -> Header | None:
    """Read the first frame header; progressive decoders keep two bytes per coefficient."""
    at = 2
    while at + 4 <= len(head):
        if head[at] != 0xFF:
            return None
        mark = head[at + 1]
        if mark == 0xFF:  # fill byte
            at += 1
        elif mark in JPEG_STANDALONE:
            at += 2
        elif mark in JPEG_FRAMES:
            height, width, components = struct.unpack_from(">HHB", head, at + 5)
            factors = [head[at + 11 + 3 * i] for i in range(components)]
            samples = [(factor >> 4) * (factor & 15) for factor in factors]
            held = 2 * sum(samples) / max(1, max(samples, default=1))
            return Header(width, height, 0 if mark in JPEG_SEQUENTIAL else held)
        else:
            at += 2 + int(struct.unpack_from(">H", head, at + 2)[0])
    return None


def _jpeg2000(head: bytes) -> Header | None:
    """Read the SIZ marker of the first codestream; a sample is decoded to 32 bits."""
    at = head.find(b"\xff\x4f\xff\x51")
    if at < 0:
        return None
    right, bottom, left, top = struct.unpack_from(">IIII", head, at + 8)
    components = struct.unpack_from(">H", head, at + 40)[0]
    return Header(right - left, bottom - top, 4 * components)


def _jpegxl(head: bytes) -> Header | None:
    """Read the size header; 6 bytes per pixel were measured for three and four channels of 8 bits."""
    at = 0
    if head[:2] != b"\xff\x0a":
        boxes = [(head.find(name), skip) for name, skip in ((b"jxlc", 4), (b"jxlp", 8))]
        at = min((found + skip for found, skip in boxes if found >= 0), default=-1)
        if at < 0 or head[at : at + 2] != b"\xff\x0a":
            return None
    bits = int.from_bytes(head[at + 2 : at + 18], "little")

    def read_bits(count: int) -> int:
        """Return the next bits, lowest first."""
        nonlocal bits
        value, bits = bits & ((1 << count) - 1), bits >> count
        return value

    def read_side() -> int:
        return 8 * (read_bits(5) + 1) if small else read_bits(JXL_SIZE_BITS[read_bits(2)]) + 1

    small = read_bits(1)
    height = read_side()
    ratio = read_bits(3)
    width = height * JXL_RATIOS[ratio - 1][0] // JXL_RATIOS[ratio - 1][1] if ratio else read_side()
    return Header(width, height, 6)
