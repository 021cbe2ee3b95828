"""Recognition of pictures, videos and frames by their first bytes, never by their names. Imports no torch."""

import struct
from pathlib import Path

from dg4d_lib.errors import BadInput

SNIFFED_BYTES = 4096  # of the beginning of a file, from which it is recognized

STILLS = (  # signature, suffix by which OpenImageIO finds the reader
    (b"\x89PNG\r\n\x1a\n", ".png"),
    (b"\xff\xd8\xff", ".jpg"),
    (b"II*\0", ".tif"),
    (b"MM\0*", ".tif"),
    (b"II+\0", ".tif"),
    (b"MM\0+", ".tif"),
    (b"BM", ".bmp"),
    (b"v/1\x01", ".exr"),
    (b"#?RADIANCE", ".hdr"),
    (b"#?RGBE", ".hdr"),
    (b"\0\0\0\x0cJXL ", ".jxl"),
    (b"\xff\x0a", ".jxl"),
    (b"\0\0\0\x0cjP  ", ".jp2"),
    (b"8BPS", ".psd"),
    (b"P6", ".ppm"),
    (b"P5", ".pgm"),
)
CLIPS = (  # offset of a signature, the signature, FFmpeg's name of the container
    (0, b"GIF8", "gif"),
    (0, b"\x1aE\xdf\xa3", "matroska"),
    (4, b"ftyp", "mov"),
    (4, b"moov", "mov"),
    (4, b"mdat", "mov"),
    (4, b"wide", "mov"),
    (4, b"free", "mov"),
    (4, b"skip", "mov"),
    (8, b"AVI ", "avi"),
    (0, b"FLV\x01", "flv"),
    (0, b"OggS", "ogg"),
    (0, b"\0\0\x01\xba", "mpeg"),
)
UNREADABLE_BRANDS = {b"heic": "HEIC", b"heix": "HEIC", b"mif1": "HEIC", b"avif": "AVIF", b"avis": "AVIF"}
PICTURE_SUFFIXES = {
    ".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".exr", ".hdr", ".jxl", ".jp2", ".psd", ".ppm", ".pgm",
}  # fmt: skip
ALLOWED = "pictures (PNG, JPEG, WebP, TIFF, BMP, EXR), videos (mp4, mov, webm, mkv, gif) and zips of numbered pictures"


def still_suffix(head: bytes) -> str:
    """Return the suffix of a still picture.

    Raises:
        BadInput: none that is known.
    """
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return ".webp"
    for signature, suffix in STILLS:
        if head.startswith(signature):
            return suffix
    kind = "a text file" if is_text(head) else "of a format that is not known here"
    raise BadInput(f"the file is {kind}, whatever its name says; give {ALLOWED}")


def container_of(head: bytes) -> str:
    """Return FFmpeg's name of the container that these bytes begin, or nothing; FFmpeg would also guess playlists.

    Raises:
        BadInput: a format that cannot be read here.
    """
    if head[4:8] == b"ftyp" and head[8:12] in UNREADABLE_BRANDS:
        name = UNREADABLE_BRANDS[head[8:12]]
        raise BadInput(f"{name} pictures cannot be read here; export the picture as PNG or JPEG")
    if len(head) > 188 and head[0] == head[188] == 0x47:
        return "mpegts"
    return next((name for at, signature, name in CLIPS if head[at : at + len(signature)] == signature), "")


def is_animated_png(head: bytes) -> bool:
    """Return whether a PNG announces frames (acTL) before its first pixels."""
    at = 8
    while head[:4] == b"\x89PNG" and at + 8 <= len(head):
        length, name = struct.unpack_from(">I4s", head, at)
        if name in (b"acTL", b"IDAT"):
            return bool(name == b"acTL")
        at += 12 + length
    return False


def is_text(head: bytes) -> bool:
    """Return whether these bytes are UTF-8 without a NUL."""
    try:
        head[:-3].decode()
    except UnicodeDecodeError:
        return False
    return b"\0" not in head


def is_frame_name(name: str) -> bool:
    """Return whether an entry of a zip is a frame; hidden files and macOS's copies of them are not."""
    path = Path(name)
    return path.suffix.lower() in PICTURE_SUFFIXES and not path.name.startswith(".") and "__MACOSX" not in path.parts
