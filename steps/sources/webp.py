"""Animated WebP, put together frame by frame: OpenImageIO decodes the parts, this file paints them on the canvas."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from dg4d_lib.errors import BadInput
from steps.sources.clips import MOST_DECODED, MOST_FRAMES
from steps.sources.decode_limit import DecodeLimit
from steps.sources.stills import check_size, open_still

HEADER = 12  # bytes of "RIFF", size, "WEBP"
FLAGS_AT = 20  # of a VP8X file, counted from its beginning
PART_HEADER = 16  # bytes of an ANMF chunk before its picture
CANVAS_BYTES = 28  # per pixel: the canvas as float32, and what libwebp keeps of a part
ALPHA_FLAG = 0x10  # of the VP8X chunk


@dataclass(frozen=True)
class _Part:
    left: int
    top: int
    width: int
    height: int
    duration_ms: int
    blend: bool  # over what is there, instead of in its place
    clear: bool  # its rectangle after it was shown
    picture: memoryview


def is_animated(content: bytes) -> bool:
    """Return whether these bytes, or the beginning of them, are a WebP with frames."""
    is_extended = content[:4] == b"RIFF" and content[8:16] == b"WEBPVP8X" and len(content) > FLAGS_AT
    return is_extended and bool(content[FLAGS_AT] & 0x02)


class AnimatedWebp:
    """The frames of one file.

    Attributes:
        width: pixels of the canvas.
        height: pixels of the canvas.
        fps: mean frame rate; 10 where the file asks for "as fast as possible".
    """

    def __init__(self, content: bytes, scratch: Path, limit: DecodeLimit) -> None:
        self._scratch, self._limit = scratch / "part.webp", limit
        self._parts: list[_Part] = []
        self.width = self.height = 0
        try:
            for name, chunk in _chunks(memoryview(content)[HEADER:]):
                if name == b"VP8X":
                    self.width, self.height = _int24(chunk[4:]) + 1, _int24(chunk[7:]) + 1
                elif name == b"ANMF":
                    self._parts.append(_part(chunk))
        except (IndexError, struct.error) as error:
            raise BadInput("the WebP animation is cut off or broken; export it again") from error
        check_size(self.width, self.height, "the WebP animation")
        needed = len(content) + CANVAS_BYTES * self.width * self.height
        limit.require(needed, "the WebP animation", self.width, self.height)
        if len(self._parts) > MOST_FRAMES or len(self._parts) * self.width * self.height > MOST_DECODED:
            raise BadInput("the WebP animation has too many or too large frames; cut it, or export it smaller")
        if any(part.left + part.width > self.width or part.top + part.height > self.height for part in self._parts):
            raise BadInput("a frame of the WebP animation lies outside its canvas; export it again")
        mean_ms = sum(part.duration_ms for part in self._parts) / max(1, len(self._parts))
        self.fps = 1000 / mean_ms if mean_ms > 0 else 10.0

    def __len__(self) -> int:
        return len(self._parts)

    def __iter__(self) -> Iterator[Float[ndarray, "h w 4"]]:
        """Yield every frame as it is shown, straight RGBA in [0, 1]; it is valid until the next is asked for."""
        canvas = np.zeros((self.height, self.width, 4), np.float32)
        for part in self._parts:
            self._scratch.write_bytes(_still(part))
            self._paint(part, canvas[part.top : part.top + part.height, part.left : part.left + part.width])
            yield canvas
            if part.clear:
                canvas[part.top : part.top + part.height, part.left : part.left + part.width] = 0
        self._scratch.unlink(missing_ok=True)

    def _paint(self, part: _Part, place: Float[ndarray, "h w 4"]) -> None:
        with open_still(self._scratch, "a frame of the WebP animation", self._limit, sized=False) as still:
            if (still.height, still.width) != place.shape[:2]:
                raise BadInput("a frame of the WebP animation lies outside its canvas; export it again")
            for top, band in still.bands():
                rows = place[top : top + len(band)]
                rows[:] = _over(band, rows) if part.blend else band


def _over(top: Float[ndarray, "h w 4"], bottom: Float[ndarray, "h w 4"]) -> Float[ndarray, "h w 4"]:
    """Composite one straight cut-out over another."""
    below = bottom[..., 3:] * (1 - top[..., 3:])
    alpha = top[..., 3:] + below
    color = (top[..., :3] * top[..., 3:] + bottom[..., :3] * below) / np.maximum(alpha, 1e-6)
    return np.concatenate([color, alpha], -1)


def _chunks(content: memoryview) -> Iterator[tuple[bytes, memoryview]]:
    """Yield name and payload of every RIFF chunk; payloads are padded to even length in the file."""
    at = 0
    while at + 8 <= len(content):
        (length,) = struct.unpack_from("<I", content, at + 4)
        if at + 8 + length > len(content):
            raise IndexError("a chunk is longer than the file")
        yield bytes(content[at : at + 4]), content[at + 8 : at + 8 + length]
        at += 8 + length + length % 2


def _part(chunk: memoryview) -> _Part:
    left, top, width, height, duration_ms = (_int24(chunk[i:]) for i in range(0, 15, 3))
    return _Part(
        2 * left,
        2 * top,
        width + 1,
        height + 1,
        duration_ms,
        blend=not chunk[15] & 2,
        clear=bool(chunk[15] & 1),
        picture=chunk[PART_HEADER:],
    )


def _still(part: _Part) -> bytes:
    """Return a frame's chunks as a WebP file of its own."""
    size = b"".join(struct.pack("<I", side - 1)[:3] for side in (part.width, part.height))
    flags = struct.pack("<I", ALPHA_FLAG if bytes(part.picture[:4]) in (b"ALPH", b"VP8L") else 0)
    body = b"WEBP" + b"VP8X" + struct.pack("<I", 10) + flags + size + bytes(part.picture)
    return b"RIFF" + struct.pack("<I", len(body)) + body


def _int24(content: memoryview) -> int:
    return content[0] | content[1] << 8 | content[2] << 16
