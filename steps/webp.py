"""Animated WebP, put together frame by frame: OpenImageIO decodes the parts, this file paints them on the canvas."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput
from steps.clips import MOST_DECODED, MOST_FRAMES
from steps.stills import check_size, decode_still

HEADER = 12  # bytes of "RIFF", size, "WEBP"
PART_HEADER = 16  # bytes of an ANMF chunk before its picture
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
    picture: bytes


def is_animated(content: bytes) -> bool:
    """Whether these bytes, or the beginning of them, are a WebP with frames."""
    return content[:4] == b"RIFF" and content[8:16] == b"WEBPVP8X" and bool(content[20] & 0x02)


class AnimatedWebp:
    """The frames of one file.

    Attributes:
        width: pixels of the canvas.
        height: pixels of the canvas.
        fps: mean frame rate; 10 where the file asks for "as fast as possible".
    """

    def __init__(self, content: bytes, scratch: Path) -> None:
        self._scratch = scratch / "part.webp"
        self._parts: list[_Part] = []
        self.width = self.height = 0
        try:
            for name, chunk in _chunks(content[HEADER:]):
                if name == b"VP8X":
                    self.width, self.height = _int24(chunk[4:]) + 1, _int24(chunk[7:]) + 1
                elif name == b"ANMF":
                    self._parts.append(_part(chunk))
        except (IndexError, struct.error) as error:
            raise BadInput("the WebP animation is cut off or broken; export it again") from error
        check_size(self.width, self.height, "the WebP animation")
        if len(self._parts) > MOST_FRAMES or len(self._parts) * self.width * self.height > MOST_DECODED:
            raise BadInput("the WebP animation has too many or too large frames; cut it, or export it smaller")
        if any(part.left + part.width > self.width or part.top + part.height > self.height for part in self._parts):
            raise BadInput("a frame of the WebP animation lies outside its canvas; export it again")
        mean_ms = sum(part.duration_ms for part in self._parts) / max(1, len(self._parts))
        self.fps = 1000 / mean_ms if mean_ms > 0 else 10.0

    def __len__(self) -> int:
        return len(self._parts)

    def __iter__(self) -> Iterator[Float[Tensor, "h w 4"]]:
        """Every frame as it is shown, straight RGBA in [0, 1]."""
        canvas = torch.zeros(self.height, self.width, 4)
        for part in self._parts:
            self._scratch.write_bytes(_still(part))
            picture, _ = decode_still(self._scratch, "a frame of the WebP animation", limits=False)
            place = (slice(part.top, part.top + part.height), slice(part.left, part.left + part.width))
            if picture.shape != canvas[place].shape:
                raise BadInput("a frame of the WebP animation lies outside its canvas; export it again")
            canvas[place] = _over(picture, canvas[place]) if part.blend else picture
            yield canvas.clone()
            if part.clear:
                canvas[place] = 0
        self._scratch.unlink(missing_ok=True)


def _over(top: Float[Tensor, "h w 4"], bottom: Float[Tensor, "h w 4"]) -> Float[Tensor, "h w 4"]:
    """One straight cut-out over another."""
    below = bottom[..., 3:] * (1 - top[..., 3:])
    alpha = top[..., 3:] + below
    color = (top[..., :3] * top[..., 3:] + bottom[..., :3] * below) / alpha.clamp(min=1e-6)
    return torch.cat([color, alpha], -1)


def _chunks(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Name and payload of every RIFF chunk; payloads are padded to even length in the file."""
    at = 0
    while at + 8 <= len(content):
        (length,) = struct.unpack_from("<I", content, at + 4)
        if at + 8 + length > len(content):
            raise IndexError("a chunk is longer than the file")
        yield content[at : at + 4], content[at + 8 : at + 8 + length]
        at += 8 + length + length % 2


def _part(chunk: bytes) -> _Part:
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
    """A frame's chunks as a WebP file of its own."""
    size = b"".join(struct.pack("<I", side - 1)[:3] for side in (part.width, part.height))
    flags = struct.pack("<I", ALPHA_FLAG if part.picture[:4] in (b"ALPH", b"VP8L") else 0)
    body = b"WEBP" + b"VP8X" + struct.pack("<I", 10) + flags + size + part.picture
    return b"RIFF" + struct.pack("<I", len(body)) + body


def _int24(content: bytes) -> int:
    return content[0] | content[1] << 8 | content[2] << 16
