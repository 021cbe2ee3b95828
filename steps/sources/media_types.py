"""Recognition of pictures, videos and frames by their first bytes, never by their names. Imports no torch."""

import codecs
import re
import struct
import zipfile
from collections.abc import Iterable
from pathlib import Path

from dg4d_lib.errors import BadInput
from steps.artifacts.archives import MOST_ENTRIES, ZIP_ERRORS
from steps.sources.gif import has_two_frames

SNIFFED_BYTES = 4096  # beginning of a file, from which it is recognized

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
SPACE = rb"(?:\s|#[^\n]*\n)+"
NETPBM = re.compile(rb"P[56]" + SPACE + rb"\d+" + SPACE + rb"\d+" + SPACE + rb"\d+\s")
BMP_HEADERS = {12, 40, 52, 56, 64, 108, 124}  # bytes, at offset 14
CLIPS = (  # offset of a signature, the signature, FFmpeg's name of the container
    (0, b"GIF8", "gif"),
    (0, b"\x1aE\xdf\xa3", "matroska"),
    *((4, box, "mov") for box in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip")),
    (8, b"AVI ", "avi"),
    (0, b"FLV\x01", "flv"),
    (0, b"OggS", "ogg"),
    (0, b"\0\0\x01\xba", "mpeg"),
)
HEIC = "HEIC pictures cannot be read here; export the picture as PNG or JPEG"
UNREADABLE_BRANDS = {
    **dict.fromkeys((b"heic", b"heix", b"mif1"), HEIC),
    b"avis": "animated AVIF cannot be read here; export the animation as MP4, GIF or WebP",
}
PICTURE_SUFFIXES = {
    ".png", ".jpg", ".jpeg", ".webp", ".avif", ".tif", ".tiff", ".bmp", ".exr", ".hdr", ".jxl", ".jp2", ".psd", ".ppm",
    ".pgm",
}  # fmt: skip
MODEL_SUFFIXES = (".glb", ".gltf", ".obj", ".usdz", ".ply", ".spz")
SCENE_SUFFIXES = {".usd", ".usda", ".usdc"}  # layers of a USDZ, which is a zip of a scene and its textures
CLUTTER = {"Thumbs.db", "desktop.ini"}  # files that Windows adds to folders
NPY = b"\x93NUMPY"
UNREADABLE = (*ZIP_ERRORS, MemoryError, OSError)
ALLOWED = (
    "pictures (PNG, JPEG, WebP, AVIF, TIFF, BMP, EXR), videos (mp4, mov, webm, mkv, gif) and zips of numbered pictures"
)


def still_suffix(head: bytes) -> str:
    """Return the suffix of a still picture.

    Raises:
        BadInput: the format is unknown.
    """
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return ".webp"
    if is_avif(head):
        return ".avif"
    text = is_text(head)
    for signature, suffix in STILLS:
        if head.startswith(signature) and _is_plausible(head, suffix, text):
            return suffix
    kind = "a text file" if text else "of a format that is not known here"
    raise BadInput(f"the file is {kind}, whatever its name says; give {ALLOWED}")


def container_of(head: bytes) -> str:
    """Return FFmpeg's name of the container that these bytes begin, or ""; FFmpeg itself would also accept playlists.

    Raises:
        BadInput: a format that cannot be read here.
    """
    if is_avif(head):
        return ""
    if head[4:8] == b"ftyp" and head[8:12] in UNREADABLE_BRANDS:
        raise BadInput(UNREADABLE_BRANDS[head[8:12]])
    if is_text(head):
        return ""
    if len(head) > 188 and {head[at] for at in range(0, min(len(head), 377), 188)} == {0x47}:
        return "mpegts"
    return next((name for at, signature, name in CLIPS if head[at : at + len(signature)] == signature), "")


def is_avif(head: bytes) -> bool:
    """Return True for the beginning of a still AVIF: brand "avif", or plain HEIF that is compatible with it."""
    if head[4:8] != b"ftyp":
        return False
    brands = head[16 : min(len(head), int.from_bytes(head[:4], "big"))]
    compatible = [brands[at : at + 4] for at in range(0, len(brands), 4)]
    return head[8:12] == b"avif" or (head[8:12] == b"mif1" and b"avif" in compatible)


def is_animated_png(head: bytes) -> bool:
    """Return True for a PNG with an animation chunk (acTL) before its first pixels."""
    at = 8
    while head[:4] == b"\x89PNG" and at + 8 <= len(head):
        length, name = struct.unpack_from(">I4s", head, at)
        if name in (b"acTL", b"IDAT"):
            return bool(name == b"acTL")
        at += 12 + length
    return False


def is_video(path: Path) -> bool:
    """Return True for a file that cannot be a single picture: a video, a zip of frames, or a GIF with two frames.

    False for animated PNG and WebP, whose frames are counted when they are decoded, and for what cannot be read.
    """
    try:
        head = _head(path)
        container = container_of(head)
    except BadInput:
        return False
    return has_two_frames(path) if container == "gif" else bool(container) or is_zip(head)


def is_text(head: bytes) -> bool:
    """Return True for UTF-8 without a NUL; the last character may be cut off."""
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return False
    return b"\0" not in head


def is_zip(head: bytes) -> bool:
    """Return True for the beginning of a zip."""
    return head[:4] in (b"PK\3\4", b"PK\5\6")


def is_frame_name(name: str) -> bool:
    """Return True for an entry of a zip that is a frame; hidden files and those of macOS are not."""
    return Path(name).suffix.lower() in PICTURE_SUFFIXES and not _is_clutter(name)


def check_no_scene(names: Iterable[str]) -> None:
    """Refuse a zip that is a USDZ: its pictures are textures, not frames.

    Raises:
        BadInput: it holds a scene; names it and the allowed files.
    """
    scene = next((name for name in names if Path(name).suffix.lower() in SCENE_SUFFIXES), None)
    if scene is not None:
        raise BadInput(f"the zip is a 3D scene (USDZ, it holds {scene!r}), which is not a source; give {ALLOWED}")


def frame_suffix(name: str, head: bytes) -> str:
    """Return the suffix of a frame in a zip, by its first bytes.

    Raises:
        BadInput: names the frame and says what it is.
    """
    if not head:
        raise BadInput(f"the frame {name} is empty (0 bytes); export it again")
    try:
        return still_suffix(head)
    except BadInput as error:
        raise BadInput(f"the frame {name}: {error}") from error


def check_head(head: bytes) -> None:
    """Refuse bytes that begin neither a picture, a video nor a zip.

    Raises:
        BadInput: says what they are and what to give.
    """
    if not head:
        raise BadInput(f"the file is empty (0 bytes); give {ALLOWED}")
    if not is_zip(head) and not container_of(head):
        still_suffix(head)


def check_media(path: Path) -> None:
    """Refuse a file that is neither a picture, a video nor a zip of frames; only the beginning is read.

    Raises:
        BadInput: says what it is and what to give.
    """
    head = _head(path)
    check_head(head)
    if is_zip(head):
        _check_zip(path)


def check_still(path: Path) -> None:
    """Refuse a file that is not a picture.

    Raises:
        BadInput: says what it is and what to give.
    """
    try:
        still_suffix(_head(path))
    except BadInput as error:
        raise BadInput(f"{path.name}: {error}") from error


def check_arrays(path: Path) -> None:
    """Refuse a file that is not a NumPy archive.

    Raises:
        BadInput: says so.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            foreign = [info.filename for info in archive.infolist() if not _begins(archive, info, NPY)]
    except UNREADABLE as error:
        raise BadInput(f"{path} is not a NumPy archive (.npz): {error}") from error
    if foreign:
        raise BadInput(f"{path} is not a NumPy archive (.npz): {foreign[0]} is not an array")


def _check_zip(path: Path) -> None:
    """Refuse a zip that holds anything but pictures, or fewer than two."""
    try:
        with zipfile.ZipFile(path) as archive:
            entries = [info for info in archive.infolist() if not info.is_dir() and not _is_clutter(info.filename)]
            if len(entries) > MOST_ENTRIES:
                raise BadInput(f"the zip holds {len(entries)} files; at most {MOST_ENTRIES} are looked at")
            check_no_scene(info.filename for info in entries)
            for info in entries:
                if not is_frame_name(info.filename):
                    raise BadInput(f"the zip holds {info.filename!r}, which is not a frame; pack the pictures alone")
                with archive.open(info) as file:
                    frame_suffix(info.filename, file.read(SNIFFED_BYTES))
    except UNREADABLE as error:
        raise BadInput("the zip of frames is broken or encrypted; pack it again") from error
    if len(entries) < 2:
        raise BadInput(f"the zip holds {len(entries) or 'no'} picture{'s' * (len(entries) != 1)}; give two or more")


def _begins(archive: zipfile.ZipFile, info: zipfile.ZipInfo, signature: bytes) -> bool:
    with archive.open(info) as file:
        return file.read(len(signature)) == signature


def _is_clutter(name: str) -> bool:
    """Return True for an entry of a zip that an operating system added."""
    path = Path(name)
    return path.name.startswith(".") or path.name in CLUTTER or "__MACOSX" in path.parts


def _is_plausible(head: bytes, suffix: str, text: bool) -> bool:
    """Return True if the header fits the signature; signatures of two letters also begin other files."""
    if suffix in (".ppm", ".pgm"):
        return NETPBM.match(head) is not None
    if suffix == ".bmp":
        return int.from_bytes(head[14:18], "little") in BMP_HEADERS
    return suffix == ".hdr" or not text  # HDR has a text header and a long signature


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(SNIFFED_BYTES)
    except OSError as error:
        raise BadInput(f"{path} cannot be read: {error.strerror}") from error
