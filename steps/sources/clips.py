"""Video reader on PyAV, in two passes: count the frames, then decode and shrink the selected ones."""

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import cast

import av
import torch
from av.error import FFmpegError
from av.video.codeccontext import VideoCodecContext
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.video.downscaling import downscale_in_bands
from dg4d_lib.video.framing import downscaled_size
from steps.sources.decode_limit import DecodeLimit
from steps.sources.stills import MOST_PIXELS, check_size

LARGEST_SIDE = 1024  # pixels of a frame after shrinking
MOST_WORK = 32 * LARGEST_SIDE**2  # pixels of all kept frames: 0.5 GB as float32 RGBA; more frames are shrunk further
MOST_FRAMES = 9000  # five minutes at 30 per second, all of which are decoded
MOST_DECODED = 40_000_000_000  # pixels of all frames before shrinking: 9,000 of 2560 x 1600
MOST_DECODING_S = 900.0  # for one pass over a video; only hostile files take longer
USUAL_FPS = 24.0  # assumed for files without a rate
SAME_RATE = 0.02  # relative difference up to which the header's rate is preferred to the time stamps
HELD_FRAMES = 4  # frames that a decoder keeps at least: references and reordered ones
ALPHA_DECODERS = {"vp9": "libvpx-vp9", "vp8": "libvpx"}  # FFmpeg's own decoders drop the alpha plane of WebM


def evenly_spaced(count: int, most: int) -> list[int]:
    """Return at most `most` indices below `count`, first and last included, as evenly as integers allow."""
    if count <= most:
        return list(range(count))
    return [round(i * (count - 1) / (most - 1)) for i in range(most)]


def thinned_rate(fps: float, count: int, kept: int) -> float:
    """Return the frame rate at which `kept` of `count` frames last as long as all of them."""
    return fps * (kept - 1) / (count - 1) if count > 1 else fps


def work_side(count: int) -> int:
    """Return the longest side, in pixels, that so many frames may have."""
    return min(LARGEST_SIDE, math.isqrt(MOST_WORK // max(1, count)))


class KeptFrames:
    """Selected frames of a video, in one tensor.

    Attributes:
        side: longest side of a frame, pixels.
        frames: straight RGBA in [0, 1]; empty until the first is added.
    """

    def __init__(self, indices: Sequence[int], what: str) -> None:
        self._places, self._what = {index: place for place, index in enumerate(indices)}, what
        self.side = work_side(len(indices))
        self.frames: Float[Tensor, "t h w 4"] = torch.empty(0, 0, 0, 4)

    def __contains__(self, index: int) -> bool:
        return index in self._places

    def add(self, index: int, frame: Float[Tensor, "h w 4"]) -> None:
        """Put a frame in its place.

        Raises:
            BadInput: it has another size than those before.
        """
        if not len(self.frames):
            self.frames = torch.zeros(len(self._places), *frame.shape)
        if frame.shape != self.frames.shape[1:]:
            raise BadInput(f"{self._what} changes its size on the way; export it again at one size")
        self.frames[self._places[index]] = frame


class Clip:
    """One video file.

    Attributes:
        count: frames that can be decoded.
        announced: number of frames in the header; 0 if absent.
        fps: frames per second.
        size: width and height of the upright frames in pixels, before shrinking; known after `read`.
    """

    size: tuple[int, int] = (0, 0)

    def __init__(self, path: Path, container: str, limit: DecodeLimit) -> None:
        self._path, self._container, self._limit = path, container, limit
        times = [frame.time for frame in self._frames()]
        self.count = len(times)
        if self.announced > 0 and self.count == 0:
            raise BadInput(
                f"the video is cut off or broken: none of its {self.announced} frames can be read; copy it again"
            )
        self.fps = self._rate(times)

    def read(self, indices: Sequence[int]) -> tuple[Float[Tensor, "t h w 4"], bool]:
        """Return the frames of these ascending indices, and True if the codec carries alpha."""
        kept, has_alpha = KeptFrames(indices, "the video"), False
        for i, frame in enumerate(self._frames()):
            if i in kept:
                has_alpha = has_alpha or any(part.is_alpha for part in frame.format.components)
                kept.add(i, _picture(frame, kept.side, has_alpha))
                turned = round(frame.rotation / 90) % 2
                self.size = (frame.height, frame.width) if turned else (frame.width, frame.height)
        return kept.frames, has_alpha

    def _frames(self) -> Iterator[av.VideoFrame]:
        try:
            with av.open(str(self._path), format=self._container, metadata_errors="replace") as container:
                if not container.streams.video:
                    found = "holds only sound or other tracks" if len(container.streams) else "is cut off or broken"
                    raise BadInput(f"the video {found}: there are no pictures in it; give another file")
                stream = container.streams.video[0]
                context = stream.codec_context
                if context is None:
                    raise BadInput("the video uses a codec that is not known here; export it as H.264 mp4")
                if context.width and context.height:
                    check_size(context.width, context.height, "the video")
                    self._require(context.width, context.height, context.pix_fmt)
                self.announced = stream.frames
                self._header_rate = float(stream.average_rate or 0)
                name = ALPHA_DECODERS.get(context.name, "") if stream.metadata.get("alpha_mode") == "1" else ""
                decoder = cast(VideoCodecContext, av.CodecContext.create(name, "r")) if name else context
                decoder.options = {"max_pixels": str(MOST_PIXELS)}  # frames may be larger than the header says
                frames = (frame for packet in container.demux(stream) for frame in decoder.decode(packet))
                yield from self._bounded(frames)
        except FFmpegError as error:
            raise BadInput(
                f"the video is cut off or broken ({error.strerror}); copy it again, or export it as H.264 mp4"
            ) from error

    def _require(self, width: int, height: int, pixel_format: str | None) -> None:
        """Refuse frames that are too large for the memory; formats have 12 to 32 bits per pixel, mostly."""
        bits = av.VideoFormat(pixel_format, width, height).padded_bits_per_pixel if pixel_format else 12
        self._limit.require(HELD_FRAMES * width * height * bits / 8, "a frame of the video", width, height)

    def _bounded(self, frames: Iterable[av.VideoFrame]) -> Iterator[av.VideoFrame]:
        """Yield the frames of one pass; raise when their number, size or time exceeds the limits."""
        start, pixels = time.monotonic(), 0
        for number, frame in enumerate(frames, 1):
            check_size(frame.width, frame.height, "the video")
            pixels += frame.width * frame.height
            if number > MOST_FRAMES or pixels > MOST_DECODED:
                raise BadInput(
                    f"the video has more than {MOST_FRAMES} frames, or more than {MOST_DECODED // 10**9} billion "
                    "pixels in all; cut it to the part that should become an animation, or export it smaller"
                )
            if time.monotonic() - start > MOST_DECODING_S:
                raise BadInput(f"the video takes more than {MOST_DECODING_S:g} s to read; cut it, or export it smaller")
            yield frame

    def _rate(self, times: Sequence[float | None]) -> float:
        """Return the header's frame rate, unless the time stamps contradict it."""
        known = [time for time in times if time is not None]
        span = known[-1] - known[0] if len(known) > 1 else 0.0
        measured = (len(known) - 1) / span if span > 0 else 0.0
        if measured and abs(self._header_rate - measured) > SAME_RATE * measured:
            return measured
        return self._header_rate or measured or USUAL_FPS


def _picture(frame: av.VideoFrame, side: int, has_alpha: bool) -> Float[Tensor, "h w 4"]:
    """Return a frame as straight RGBA, upright, no side longer than `side`."""
    width, height = frame.width, frame.height
    if not has_alpha:  # FFmpeg's scaler does not weight colors by alpha
        height, width = downscaled_size(height, width, side)
    pixels = frame.reformat(width=width, height=height, format="rgba", interpolation="AREA").to_ndarray()
    picture = downscale_in_bands(torch.from_numpy(pixels), side)
    return torch.rot90(picture, round(frame.rotation / 90)).contiguous()
