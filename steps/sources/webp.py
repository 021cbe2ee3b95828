"""Animated WebP reader on Pillow, whose decoder composes the frames."""

from collections.abc import Iterator
from io import SEEK_END
from typing import BinaryIO

import numpy as np
import torch
from jaxtyping import UInt8
from PIL.WebPImagePlugin import WebPImageFile
from torch import Tensor

from dg4d_lib.errors import BadInput
from steps.sources.clips import FASTEST_MS, MOST_DECODED, MOST_FRAMES, SLOWED_MS, measured_rate
from steps.sources.decode_limit import DecodeLimit
from steps.sources.decoder_errors import damage_is_bad_input
from steps.sources.stills import check_size

NAME = "the WebP animation"  # in messages
FLAGS_AT, SIZE_AT, HEADER_BYTES = 20, 24, 30  # offsets in a VP8X file
CHUNK_BYTES = (10).to_bytes(4, "little")  # length of a VP8X chunk, before its flags
ANIMATION_FLAG = 0x02
FILE_COPIES = 3  # copies of the file that Pillow holds while it opens one
CANVAS_BYTES = 28  # per pixel: two canvases of libwebp, Pillow's copies, and planes of the current frame


def is_animated(content: bytes) -> bool:
    """Return True for the beginning of a WebP with frames."""
    is_extended = content[:4] == b"RIFF" and content[8:16] == b"WEBPVP8X" and len(content) > FLAGS_AT
    return is_extended and bool(content[FLAGS_AT] & ANIMATION_FLAG)


class AnimatedWebp:
    """Frames of one file, which must stay open while they are read.

    Attributes:
        times: seconds at which the frames begin that were read so far.

    Raises:
        BadInput: the file is damaged, or has too many or too large frames.
    """

    def __init__(self, file: BinaryIO, limit: DecodeLimit) -> None:
        header, size_bytes = file.read(HEADER_BYTES), file.seek(0, SEEK_END)
        if len(header) < HEADER_BYTES or header[FLAGS_AT - 4 : FLAGS_AT] != CHUNK_BYTES:
            raise BadInput(f"{NAME} is cut off or broken; export it again")
        sides = (header[at : at + 3] for at in (SIZE_AT, SIZE_AT + 3))
        self.width, self.height = (int.from_bytes(side, "little") + 1 for side in sides)
        check_size(self.width, self.height, NAME)
        needed = FILE_COPIES * size_bytes + CANVAS_BYTES * self.width * self.height
        limit.require(needed, NAME, self.width, self.height)
        file.seek(0)
        with damage_is_bad_input(NAME):
            self._image = WebPImageFile(file)  # `Image.open` would warn about sizes that are allowed here
        if len(self) > MOST_FRAMES or len(self) * self.width * self.height > MOST_DECODED:
            raise BadInput(f"{NAME} has too many or too large frames; cut it, or export it smaller")
        self.times: list[float] = []

    @property
    def fps(self) -> float:
        """Mean frame rate of the frames read so far; 0 before the second."""
        return measured_rate(self.times)

    def __len__(self) -> int:
        return int(self._image.n_frames)

    def __iter__(self) -> Iterator[UInt8[Tensor, "h w 4"]]:
        """Yield every composed frame as straight RGBA."""
        start_ms = 0.0
        for number in range(len(self)):
            with damage_is_bad_input(NAME):
                self._image.seek(number)
                frame = torch.from_numpy(np.array(self._image.convert("RGBA")))
            self.times.append(start_ms / 1000)
            duration_ms = self._image.info["duration"]
            start_ms += duration_ms if duration_ms > FASTEST_MS else SLOWED_MS
            yield frame
