"""JPEG files: broken, hostile, and sound but unusual."""

import functools
import struct
from collections.abc import Callable

from PIL import Image

from tests.hostile.formats import (
    cut,
    noise,
    saved,
    subject,
)
from tests.hostile.samples import (
    frames_zip,
    noise_jpeg,
    sound_jpeg,
)

Make = Callable[[], bytes]


def segment(content: bytes, marker: int) -> int:
    """Return where a segment of a JPEG begins."""
    return content.index(bytes([0xFF, marker]))


def _sof(width: int, height: int, channels: int | None = None, precision: int = 8) -> bytes:
    content = noise_jpeg()
    at = segment(content, 0xC0)
    count = content[at + 9] if channels is None else channels
    return content[: at + 4] + struct.pack(">BHHB", precision, height, width, count) + content[at + 10 :]


def _without(marker: int) -> bytes:
    content = noise_jpeg()
    while bytes([0xFF, marker]) in content:
        at = segment(content, marker)
        content = content[:at] + content[at + 2 + struct.unpack_from(">H", content, at + 2)[0] :]
    return content


def _with_segment(content: bytes, marker: int, body: bytes, length: int | None = None) -> bytes:
    size = len(body) + 2 if length is None else length
    return content[:2] + bytes([0xFF, marker]) + struct.pack(">H", size) + body + content[2:]


def scans(count: int) -> bytes:
    """Return a progressive JPEG of 4,000 pixels a side whose last scan is repeated: each asks for the whole picture."""
    content = saved(Image.new("L", (4000, 4000), 128), "JPEG", progressive=True)
    at = content.rindex(b"\xff\xda")
    return content[:at] + content[at:-2] * count + content[-2:]


def oriented(orientation: int) -> bytes:
    exif = Image.Exif()
    exif[0x0112] = orientation
    return saved(subject(), "JPEG", exif=exif)


JPEGS: dict[str, Make] = {
    "jpeg: marker alone": lambda: noise_jpeg()[:3],
    "jpeg: cut within the tables": lambda: noise_jpeg()[:100],
    "jpeg: cut at a fifth": lambda: cut(noise_jpeg(), 0.2),
    "jpeg: cut at a half": lambda: cut(noise_jpeg(), 0.5),
    "jpeg: cut at nine tenths": lambda: cut(noise_jpeg(), 0.9),
    "jpeg: 65,535 a side": lambda: _sof(65_535, 65_535),
    "jpeg: no width": lambda: _sof(0, 128),
    "jpeg: no height": lambda: _sof(128, 0),
    "jpeg: five channels": lambda: _sof(128, 128, channels=5),
    "jpeg: 7 bits": lambda: _sof(128, 128, precision=7),
    "jpeg: no Huffman tables": lambda: _without(0xC4),
    "jpeg: no quantization tables": lambda: _without(0xDB),
    "jpeg: no frame": lambda: _without(0xC0),
    "jpeg: a segment longer than the file": lambda: _with_segment(cut(noise_jpeg(), 0.1), 0xE1, b"Exif\0\0", 65_535),
    "jpeg: tables alone": lambda: noise_jpeg()[: segment(noise_jpeg(), 0xDA)] + b"\xff\xd9",
    "jpeg: lossless": lambda: noise_jpeg().replace(b"\xff\xc0", b"\xff\xc3", 1),
    "jpeg: hierarchical": lambda: noise_jpeg().replace(b"\xff\xc0", b"\xff\xc5", 1),
    "jpeg: 60 scans of 16 million pixels": lambda: scans(60),
    "jpeg: 31 x 20": lambda: saved(noise(31).crop((0, 0, 31, 20)), "JPEG"),
    # sound
    "jpeg: no end": lambda: sound_jpeg()[:-2],
    "jpeg: zip behind": lambda: sound_jpeg() + frames_zip(),
    "jpeg: page in a comment": lambda: _with_segment(sound_jpeg(), 0xFE, b"<html><script>alert(1)</script>"),
    "jpeg: EXIF that points to itself": lambda: _with_segment(
        sound_jpeg(), 0xE1, b"Exif\0\0II*\0\x08\0\0\0\x01\0\x69\x87\x04\0\x01\0\0\0\x08\0\0\0\x08\0\0\0"
    ),
    "jpeg: thumbnail that is not a picture": lambda: _with_segment(sound_jpeg(), 0xE0, b"JFXX\0\x10" + bytes(40)),
    "jpeg: CMYK": lambda: saved(subject("CMYK"), "JPEG", quality=95),
    "jpeg: gray": lambda: saved(subject("L"), "JPEG"),
    "jpeg: progressive": lambda: saved(subject(), "JPEG", progressive=True),
    "jpeg: restart markers": lambda: saved(subject(), "JPEG", restart_marker_blocks=1),
    "jpeg: profile of CMYK in RGB": lambda: saved(
        subject(), "JPEG", icc_profile=b"\0\0\x02\x0cADBE\x02\x10\0\0prtrCMYK" + bytes(500)
    ),
    "jpeg: broken profile": lambda: saved(subject(), "JPEG", icc_profile=b"no profile at all"),
    **{f"jpeg: orientation {n}": functools.partial(oriented, n) for n in (0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 65535)},
}
