"""Builders of file formats, byte by byte where an encoder would refuse to write what a test needs."""

import io
import struct
import zlib
from collections.abc import Iterable, Sequence

import numpy as np
from numpy import ndarray
from PIL import Image

SIZE = 64  # pixels of a side of nearly every picture
HUGE = 2**31 - 1
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def disc(left: int = 16, size: int = SIZE, color: tuple[int, int, int] = (200, 60, 30)) -> ndarray:
    """Return an RGBA disc of radius 16 over transparent white."""
    rows, columns = np.mgrid[:size, :size]
    inside = (rows - size // 2) ** 2 + (columns - left - 16) ** 2 < 16**2
    picture = np.full((size, size, 4), 255, np.uint8)
    picture[inside, :3] = color
    picture[..., 3] = 255 * inside
    return picture


def opaque(picture: ndarray) -> ndarray:
    """Return the picture over white, without alpha."""
    alpha = picture[..., 3:] / 255
    return np.round(picture[..., :3] * alpha + 255 * (1 - alpha)).astype(np.uint8)


def subject(mode: str = "RGB") -> Image.Image:
    """Return the disc as an image of Pillow; every mode without alpha shows it over white."""
    image = Image.fromarray(disc())
    if mode == "LA":
        return image.convert("LA")
    return image if mode == "RGBA" else Image.fromarray(opaque(disc())).convert(mode)


def saved(image: Image.Image, format_: str, **options: object) -> bytes:
    """Encode with Pillow."""
    file = io.BytesIO()
    image.save(file, format_, **options)
    return file.getvalue()


def noise(side: int = SIZE) -> Image.Image:
    """Return colors that no encoder makes small, so that a cut hits pixels."""
    pixels = np.random.default_rng(0).integers(0, 255, (side, side, 3), np.uint8)
    return Image.fromarray(pixels)


def cut(content: bytes, share: float) -> bytes:
    """Return the beginning of a file."""
    return content[: int(share * len(content))]


def flipped(content: bytes, at: int) -> bytes:
    """Return the file with one byte inverted."""
    return content[:at] + bytes([content[at] ^ 0xFF]) + content[at + 1 :]


# PNG


def chunk(name: bytes, content: bytes, length: int | None = None, checksum: int | None = None) -> bytes:
    """Return a PNG chunk; length and checksum may lie."""
    right = zlib.crc32(name + content)
    return (
        struct.pack(">I", len(content) if length is None else length)
        + name
        + content
        + struct.pack(">I", right if checksum is None else checksum)
    )


def ihdr(
    width: int = SIZE, height: int = SIZE, depth: int = 8, color: int = 0, rest: tuple[int, ...] = (0, 0, 0)
) -> bytes:
    """Return the header chunk of a PNG."""
    return chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, color, *rest))


def gray_rows(width: int = SIZE, height: int = SIZE) -> bytes:
    """Return unfiltered gray rows with a dark square in the middle."""
    pixels = np.full((height, width + 1), 255, np.uint8)
    pixels[:, 0] = 0
    pixels[height // 4 : 3 * height // 4, 1 + width // 4 : 3 * width // 4] = 40
    return pixels.tobytes()


def png(*chunks: bytes, end: bool = True) -> bytes:
    """Return a PNG of these chunks; without any, a sound gray one."""
    body = chunks or (ihdr(), chunk(b"IDAT", zlib.compress(gray_rows())))
    return PNG_SIGNATURE + b"".join(body) + (chunk(b"IEND", b"") if end else b"")


def claimed_png(width: int, height: int) -> bytes:
    """Return a PNG whose header claims a size that its pixels do not fill."""
    return png(ihdr(width, height), chunk(b"IDAT", zlib.compress(bytes(64 * 65))))


def zeros_png(side: int, depth: int = 8, color: int = 0, channels: int = 1) -> bytes:
    """Return a sound PNG of black pixels, deflated without holding them."""
    packer = zlib.compressobj(9)
    row = bytes(1 + side * channels * depth // 8)
    parts = [packer.compress(row) for _ in range(side)]
    return png(ihdr(side, side, depth, color), chunk(b"IDAT", b"".join([*parts, packer.flush()])))


def apng(frames: int, claimed: int | None = None, delay: tuple[int, int] = (1, 10), offset: int = 0) -> bytes:
    """Return an animated gray PNG; the number of frames may lie, frames may lie outside."""
    rows = zlib.compress(gray_rows())
    parts = [ihdr(), chunk(b"acTL", struct.pack(">II", frames if claimed is None else claimed, 0))]
    number = 0
    for i in range(frames):
        place = (SIZE, SIZE, offset, offset)
        parts.append(chunk(b"fcTL", struct.pack(">IIIIIHHBB", number, *place, *delay, 0, 0)))
        number += 1
        if i == 0:
            parts.append(chunk(b"IDAT", rows))
        else:
            parts.append(chunk(b"fdAT", struct.pack(">I", number) + rows))
            number += 1
    return png(*parts)


# TIFF


def tiff(
    tags: dict[int, int | tuple[int, int, int]],
    tail: bytes = bytes(1200),
    next_ifd: int = 0,
    count: int | None = None,
    order: str = "<",
) -> bytes:
    """Return a TIFF of one directory; a tag is a value, or (type, count, value or offset).

    The tail begins at 8 + 2 + 12 per tag + 4.
    """
    entries = b"".join(
        struct.pack(f"{order}HHII", tag, *(value if isinstance(value, tuple) else (4, 1, value)))
        for tag, value in sorted(tags.items())
    )
    number = len(tags) if count is None else count
    head = b"II*\0" if order == "<" else b"MM\0*"
    return head + struct.pack(f"{order}IH", 8, number) + entries + struct.pack(f"{order}I", next_ifd) + tail


def gray_tags(
    width: int = SIZE, height: int = SIZE, **changes: int | tuple[int, int, int]
) -> dict[int, int | tuple[int, int, int]]:
    """Return the tags of a gray TIFF of one strip; a change is `tN=value`, None takes a tag away."""
    tags: dict[int, int | tuple[int, int, int]] = {
        256: width, 257: height, 258: 8, 259: 1, 262: 1, 273: 300, 277: 1, 278: height, 279: width * height,
    }  # fmt: skip
    tags |= {int(name[1:]): value for name, value in changes.items()}
    return {tag: value for tag, value in tags.items() if value is not None}


def gray_tiff(width: int = SIZE, height: int = SIZE, **changes: int | tuple[int, int, int]) -> bytes:
    """Return a TIFF whose pixels begin at byte 300."""
    tags = gray_tags(width, height, **changes)
    gap = 300 - (8 + 2 + 12 * len(tags) + 4)
    pixels = gray_rows()
    square = b"".join(pixels[i * (SIZE + 1) + 1 : (i + 1) * (SIZE + 1)] for i in range(SIZE))
    return tiff(tags, bytes(gap) + square)


# GIF


def gif(
    frames: int,
    width: int = SIZE,
    height: int = SIZE,
    place: tuple[int, int, int, int] = (0, 0, 64, 64),
    code_size: int = 2,
    data: bytes = b"\x02\x44\x01\0",
    delay: int = 1,
    end: bool = True,
) -> bytes:
    """Return an animation that repeats for ever, of frames of one byte."""
    head = b"GIF89a" + struct.pack("<HHBBB", width, height, 0x80, 0, 0) + b"\0\0\0\xff\xff\xff"
    forever = b"!\xff\x0bNETSCAPE2.0\x03\x01\0\0\0"
    control = b"!\xf9\x04\0" + struct.pack("<H", delay) + b"\0\0"
    frame = control + b"," + struct.pack("<HHHHB", *place, 0) + bytes([code_size]) + data
    return head + forever + frame * frames + (b";" if end else b"")


def animation(format_: str, count: int, duration: int | Sequence[int] = 100, **options: object) -> bytes:
    """Encode a disc that walks to the right with Pillow."""
    frames = [Image.fromarray(disc(6 + 2 * i)) for i in range(count)]
    return saved(frames[0], format_, save_all=True, append_images=frames[1:], duration=duration, **options)


# WebP


def riff(kind: bytes, *chunks: tuple[bytes, bytes], size: int | None = None) -> bytes:
    """Return a RIFF file; its size may lie."""
    body = kind + b"".join(
        name + struct.pack("<I", len(content)) + content + b"\0" * (len(content) % 2) for name, content in chunks
    )
    return b"RIFF" + struct.pack("<I", len(body) if size is None else size) + body


def int24(number: int) -> bytes:
    """Return a little-endian number of three bytes."""
    return struct.pack("<I", number)[:3]


def vp8x(width: int, height: int, flags: int = 0x12) -> tuple[bytes, bytes]:
    """Return the header chunk of an extended WebP."""
    return b"VP8X", struct.pack("<I", flags) + int24(width - 1) + int24(height - 1)


def webp_parts(content: bytes) -> list[tuple[bytes, bytes]]:
    """Return the chunks of a WebP file."""
    parts, at = [], 12
    while at + 8 <= len(content):
        (length,) = struct.unpack_from("<I", content, at + 4)
        parts.append((content[at : at + 4], content[at + 8 : at + 8 + length]))
        at += 8 + length + length % 2
    return parts


def webp_frame(
    width: int = SIZE, height: int = SIZE, left: int = 0, top: int = 0, ms: int = 100
) -> tuple[bytes, bytes]:
    """Return an ANMF chunk with the disc; what it says of its place may lie."""
    still = b"".join(
        name + struct.pack("<I", len(body)) + body + b"\0" * (len(body) % 2)
        for name, body in webp_parts(saved(subject(), "WEBP", lossless=True))
        if name in (b"VP8 ", b"VP8L", b"ALPH")
    )
    place = int24(left // 2) + int24(top // 2) + int24(width - 1) + int24(height - 1) + int24(ms) + b"\0"
    return b"ANMF", place + still


# ISO base media file format: mp4, mov, HEIC, AVIF


def box(name: bytes, *parts: bytes) -> bytes:
    """Return a box of these parts."""
    body = b"".join(parts)
    return struct.pack(">I", 8 + len(body)) + name + body


def full_box(name: bytes, *parts: bytes, version: int = 0, flags: int = 0) -> bytes:
    """Return a box with version and flags."""
    return box(name, struct.pack(">I", version << 24 | flags), *parts)


def patched(content: bytes, name: bytes, at: int, value: bytes) -> bytes:
    """Return an mp4 with other bytes in a box, counted from the box's name, at its first place in `moov`."""
    start = content.index(name, content.index(b"moov")) + at
    return content[:start] + value + content[start + len(value) :]


def heif(brand: bytes, kind: bytes, config: bytes, payload: bytes, width: int = SIZE, height: int = SIZE) -> bytes:
    """Return a HEIF still of one coded item.

    Args:
        brand: major brand, `heic` or `avif`.
        kind: item type, `hvc1` or `av01`.
        config: the configuration box, `hvcC` or `av1C`.
        payload: the coded picture.
        width: pixels that the `ispe` box claims.
        height: likewise.
    """
    size = full_box(b"ispe", struct.pack(">II", width, height))
    properties = box(
        b"iprp",
        box(b"ipco", config, size),
        full_box(b"ipma", struct.pack(">IHB", 1, 1, 2), b"\x81\x02"),
    )
    handler = full_box(b"hdlr", bytes(4), b"pict", bytes(12), b"\0")
    items = full_box(b"iinf", struct.pack(">H", 1), full_box(b"infe", struct.pack(">HH", 1, 0), kind, b"\0", version=2))
    head = box(b"ftyp", brand, bytes(4), b"mif1", brand)

    def meta(offset: int) -> bytes:
        place = full_box(b"iloc", b"\x44\0", struct.pack(">HHHHII", 1, 1, 0, 1, offset, len(payload)))
        return full_box(b"meta", handler, full_box(b"pitm", struct.pack(">H", 1)), place, items, properties)

    start = len(head) + len(meta(0)) + 8
    return head + meta(start) + box(b"mdat", payload)


# BMP, PSD, PNM


def bmp(
    width: int, height: int, depth: int = 24, compression: int = 0, data: bytes | None = None, palette: int = 0
) -> bytes:
    """Return a BMP with the usual header of 40 bytes."""
    row = (abs(width) * depth + 31) // 32 * 4
    pixels = bytes(min(row * abs(height), 65_536)) if data is None else data
    colors = bytes(range(256)) * 4
    start = 54 + 4 * palette
    head = struct.pack("<IiiHHIIiiII", 40, width, height, 1, depth, compression, len(pixels), 0, 0, palette, 0)
    return b"BM" + struct.pack("<IHHI", start + len(pixels), 0, 0, start) + head + colors[: 4 * palette] + pixels


def psd(width: int = SIZE, height: int = SIZE, channels: int = 3, planes: Iterable[bytes] | None = None) -> bytes:
    """Return a flat Photoshop file without layers."""
    pixels = opaque(disc())
    planes = [pixels[..., i].tobytes() for i in range(3)] if planes is None else planes
    head = b"8BPS" + struct.pack(">H6xHIIHH", 1, channels, height, width, 8, 3)
    return head + bytes(12) + struct.pack(">H", 0) + b"".join(planes)
