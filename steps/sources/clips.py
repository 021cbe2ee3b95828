"""Video reader on PyAV, in two passes: count the frames, then decode and shrink the selected ones."""

import math
import struct
import time
from collections.abc import Iterable, Iterator, Sequence
from itertools import accumulate, pairwise
from pathlib import Path
from typing import NamedTuple, cast

import av
import torch
from av.error import FFmpegError
from av.sidedata.sidedata import SideData
from av.video.codeccontext import VideoCodecContext
from av.video.reformatter import ColorPrimaries, ColorTrc, VideoReformatter
from jaxtyping import Float, UInt8
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.video.downscaling import downscale_in_bands
from dg4d_lib.video.framing import downscaled_size, resample
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
MOST_STRETCHED = 4.0  # ratio of the sides of a pixel; more extreme values of a header are taken as this
UNEVEN = 0.05  # share of the duration by which frames may be played before or after their time without a note
HDR_CURVES = (ColorTrc.SMPTE2084, ColorTrc.ARIB_STD_B67)  # PQ and HLG
WIDE_PRIMARIES = (ColorPrimaries.BT2020, ColorPrimaries.SMPTE432)  # the second is Display P3
ANIMATIONS = ("gif", "apng")  # containers whose shortest frames browsers show longer
FASTEST_MS = 10  # browsers show frames of animations that are this short or shorter for `SLOWED_MS`
SLOWED_MS = 100
APNG_OPTIONS = {"default_fps": str(1000 // SLOWED_MS)}  # rate of frames without a duration
ALPHA_DECODERS = {"vp9": "libvpx-vp9", "vp8": "libvpx"}  # FFmpeg's own decoders drop the alpha plane of WebM


def sampled_frames(count: int, most: int) -> list[int]:
    """Return the indices of at most `most` frames of a video of `count`, evenly spaced from the first on.

    Where `most` divides `count`, the stride is constant, such as every second frame in the paper's fast variant.
    Otherwise the last index is included, and distances differ by at most 1.
    """
    if count <= most:
        return list(range(count))
    if count % most == 0:
        return list(range(0, count, count // most))
    return [round(i * (count - 1) / (most - 1)) for i in range(most)]


def thinned_rate(fps: float, count: int, kept: int) -> float:
    """Return the rate at which `kept` evenly spaced frames of `count` move as fast as all of them do."""
    return fps * (kept - 1) / sampled_frames(count, kept)[-1] if kept > 1 else fps


def measured_rate(times: Sequence[float]) -> float:
    """Return the mean frame rate between the first and the last of the times in seconds; 0 if they do not differ."""
    span = times[-1] - times[0] if times else 0.0
    return (len(times) - 1) / span if span > 0 else 0.0


def shown_times(times: Sequence[float]) -> list[float]:
    """Return the times, in seconds, at which browsers show the frames of an animation with these times."""
    gaps_ms = [(later - time) * 1000 for time, later in pairwise(times)]
    slowed = [SLOWED_MS if round(gap, 3) <= FASTEST_MS else gap for gap in gaps_ms]
    return [total / 1000 for total in accumulate(slowed, initial=0.0)]


def uneven_note(times: Sequence[float]) -> tuple[str, ...]:
    """Return a note if frames at these times, in seconds, move differently at a constant frame rate."""
    rate = measured_rate(times)
    late = max((abs((time - times[0]) * rate - i) for i, time in enumerate(times)), default=0.0)
    if late <= UNEVEN * (len(times) - 1):
        return ()
    return (
        "The video's frames have uneven times; they are played at an even rate, so that parts of the "
        "motion are slower or faster. Export the video at a constant frame rate to keep its speed.",
    )


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
            raise BadInput(f"{self._what} changes its frame size; export it again at one size")
        self.frames[self._places[index]] = frame


class Clip:
    """One video file.

    Attributes:
        count: frames that can be decoded.
        announced: number of frames in the header; 0 if absent.
        fps: frames per second.
        size: width and height of the upright frames in square pixels, before shrinking; known after `read`.
        notes: sentences for the report about times and colors; complete after `read`.
    """

    size: tuple[int, int] = (0, 0)

    def __init__(self, path: Path, container: str, limit: DecodeLimit) -> None:
        self._path, self._container, self._limit = path, container, limit
        times: list[float | None] = [frame.time for frame in self._frames()]
        self.count = len(times)
        if self.announced > 0 and self.count == 0:
            raise BadInput(
                f"the video is cut off or broken: none of its {self.announced} frames can be read; copy it again"
            )
        known = [time for time in times if time is not None]
        known = shown_times(known) if container in ANIMATIONS else known
        self.fps, self.notes = self._rate(known), uneven_note(known)

    def read(self, indices: Sequence[int]) -> tuple[Float[Tensor, "t h w 4"], bool]:
        """Return the frames of these ascending indices, and True if the codec carries alpha."""
        kept, has_alpha, colors = KeptFrames(indices, "the video"), False, _Colors()
        for i, frame in enumerate(self._frames()):
            if i in kept:
                has_alpha = has_alpha or any(part.is_alpha for part in frame.format.components)
                width, height = max(1, round(frame.width * self._pixel_aspect)), frame.height
                check_size(width, height, "the video")
                kept.add(i, _picture(frame, width, kept.side, has_alpha, colors))
                self.size = (height, width) if _orientation(frame).is_transposed else (width, height)
        self.notes = (*self.notes, *colors.notes)
        return kept.frames, has_alpha

    def _frames(self) -> Iterator[av.VideoFrame]:
        try:
            options = APNG_OPTIONS if self._container == "apng" else {}
            with av.open(
                str(self._path), format=self._container, options=options, metadata_errors="replace"
            ) as container:
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
                stretched = float(stream.sample_aspect_ratio or 1)
                self._pixel_aspect = min(max(stretched, 1 / MOST_STRETCHED), MOST_STRETCHED)
                self._header_rate = float(stream.average_rate or 0)
                name = ALPHA_DECODERS.get(context.name, "") if stream.metadata.get("alpha_mode") == "1" else ""
                decoder = cast(VideoCodecContext, av.CodecContext.create(name, "r")) if name else context
                decoder.options = {"max_pixels": str(MOST_PIXELS)}  # frames may be larger than the header declares
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

    def _rate(self, times: Sequence[float]) -> float:
        """Return the header's frame rate, unless the time stamps contradict it."""
        measured = measured_rate(times)
        if measured and abs(self._header_rate - measured) > SAME_RATE * measured:
            return measured
        return self._header_rate or measured or USUAL_FPS


class _Colors:
    """Converter of frames to 8-bit RGBA in sRGB, kept for all frames: FFmpeg needs seconds to prepare one for HDR.

    Attributes:
        notes: a sentence if colors of a frame were HDR or of a wide gamut.
    """

    def __init__(self) -> None:
        self._reformatter = VideoReformatter()
        self.notes: tuple[str, ...] = ()

    def pixels(self, frame: av.VideoFrame, width: int, height: int) -> UInt8[Tensor, "h w 4"]:
        """Return a frame resized to these pixels."""
        curve, primaries = None, None  # those of the frame
        is_hdr = frame.color_trc in HDR_CURVES
        if is_hdr or frame.color_primaries in WIDE_PRIMARIES:
            curve, primaries = ColorTrc.IEC61966_2_1 if is_hdr else None, ColorPrimaries.BT709
            self.notes = (f"The video's {'HDR' if is_hdr else 'wide-gamut'} colors are converted to sRGB.",)
        target = {"dst_color_trc": curve, "dst_color_primaries": primaries}
        resized = self._reformatter.reformat(frame, width, height, "rgba", interpolation="AREA", **target)
        return torch.from_numpy(resized.to_ndarray())


def _picture(frame: av.VideoFrame, width: int, side: int, has_alpha: bool, colors: _Colors) -> Float[Tensor, "h w 4"]:
    """Return a frame as straight RGBA, upright, stretched to `width` and then shrunk so that no side exceeds `side`."""
    height, width = downscaled_size(frame.height, width, side)
    size = (frame.width, frame.height) if has_alpha else (width, height)  # FFmpeg's scaler does not weight by alpha
    picture = downscale_in_bands(colors.pixels(frame, *size), side)
    picture = resample(picture[None], height, width)[0]
    is_transposed, flipped = _orientation(frame)
    return (picture.transpose(0, 1) if is_transposed else picture).flip(flipped).contiguous()


class _Orientation(NamedTuple):
    """Steps that show a frame upright: swap rows and columns, then reverse these axes."""

    is_transposed: bool = False
    flipped: tuple[int, ...] = ()


def _orientation(frame: av.VideoFrame) -> _Orientation:
    """Return the nearest right-angled turn or mirror image of a frame's display matrix."""
    matrix = cast(SideData | None, frame.side_data.get("DISPLAYMATRIX"))
    if matrix is None:
        return _Orientation()
    a, b, _, c, d = struct.unpack_from("=5i", matrix)  # rows of pixels run along (a, b), columns along (c, d)
    is_transposed = abs(b) > abs(a)
    along_x, along_y = (c, b) if is_transposed else (a, d)
    return _Orientation(is_transposed, tuple(axis for axis, way in enumerate((along_y, along_x)) if way < 0))
