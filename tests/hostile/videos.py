"""Videos: broken ones, hostile ones, and sound ones that are unusual."""

import functools
import io
import os
import struct
import tempfile
from collections.abc import Callable, Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy import ndarray

from tests.hostile.formats import (
    HUGE,
    SIZE,
    box,
    cut,
    disc,
    flipped,
    full_box,
    heif,
    opaque,
    patched,
    riff,
    saved,
    subject,
)
from tests.hostile.samples import frames_zip

Make = Callable[[], bytes]
os.environ.setdefault("SVT_LOG", "0")  # the AV1 encoder prints its settings otherwise


X265 = (("x265-params", "log-level=none:bframes=0"),)  # with B-frames, a film of one frame fails now and then


def walk(count: int, size: int = SIZE) -> list[ndarray]:
    """Return RGBA frames of a disc that goes to the right."""
    return [disc(6 + 2 * i, size) for i in range(count)]


@functools.cache
def film(
    container: str = "mp4",
    codec: str = "libx264",
    count: int = 4,
    pixels: str = "yuv420p",
    width: int = SIZE,
    height: int = SIZE,
    fps: int | Fraction = 10,
    stretch: int = 1,
    options: tuple[tuple[str, str], ...] = (),
    muxer: tuple[tuple[str, str], ...] = (),
) -> bytes:
    """Encode the walk with PyAV; from the second frame on, times are stretched."""
    policy = os.sched_getscheduler(0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film"
        frames, sizes = walk(count, max(width, height)), (width, height)
        try:
            _encode(path, container, codec, frames, pixels, sizes, fps, stretch, options, muxer)
        finally:  # SVT-AV1 gives root's thread the policy SCHED_FIFO, which starves all other processes
            os.sched_setscheduler(0, policy, os.sched_param(0))
        return path.read_bytes()


def _encode(
    path: Path,
    container: str,
    codec: str,
    pictures: list[ndarray],
    pixels: str,
    size: tuple[int, int],
    fps: int | Fraction,
    stretch: int,
    options: tuple[tuple[str, str], ...],
    muxer: tuple[tuple[str, str], ...],
) -> None:
    width, height = size
    with av.open(str(path), "w", format=container, options=dict(muxer)) as output:
        stream = output.add_stream(codec, fps, dict(options))
        stream.width, stream.height, stream.pix_fmt = width, height, pixels
        for i, picture in enumerate(pictures):
            kept = picture[:height, :width] if "a" in pixels else opaque(picture[:height, :width])
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(kept), format="rgba" if "a" in pixels else "rgb24")
            frame.pts, frame.time_base = i * stretch, 1 / Fraction(fps)
            output.mux(stream.encode(frame))
        output.mux(stream.encode(None))


@functools.cache
def sound(container: str, codec: str) -> bytes:
    """Encode a second of silence."""
    file = io.BytesIO()
    with av.open(file, "w", format=container) as output:
        stream = output.add_stream(codec, 48_000)
        layout = "mono"
        planar = stream.codec_context.format.name if stream.codec_context.format else "s16"
        silence = av.AudioFrame.from_ndarray(
            np.zeros((1, 4096), np.float32 if "flt" in planar else np.int16), planar, layout
        )
        silence.sample_rate = 48_000
        output.mux(stream.encode(silence))
        output.mux(stream.encode(None))
    return file.getvalue()


def titled(container: str, codec: str = "libx264", pixels: str = "yuv420p") -> bytes:
    """Return a video with a title of bytes that are not UTF-8, as old cameras and editors write them."""
    file = io.BytesIO()
    with av.open(file, "w", format=container) as output:
        output.metadata["title"] = "caf. XXX"
        stream = output.add_stream(codec, 10)
        stream.width, stream.height, stream.pix_fmt = SIZE, SIZE, pixels
        for picture in walk(4):
            output.mux(stream.encode(av.VideoFrame.from_ndarray(opaque(picture), format="rgb24")))
        output.mux(stream.encode(None))
    return file.getvalue().replace(b"caf. XXX", b"caf\xe9 \xff\xfeX")


def turned(degrees: int) -> bytes:
    """Return an mp4 whose track header asks players to turn it."""
    cosine, sine = {0: (1, 0), 90: (0, 1), 180: (-1, 0), 270: (0, -1)}[degrees]
    matrix = struct.pack(">iii", cosine << 16, sine << 16, 0) + struct.pack(">iii", -sine << 16, cosine << 16, 0)
    return patched(film(width=64, height=48), b"tkhd", 4 + 40, matrix)


def nested(depth: int) -> bytes:
    """Return an mp4 of boxes within boxes."""
    body = b""
    for i in range(depth):
        body = struct.pack(">I", 8 + 8 * i) + b"moov" + body
    return box(b"ftyp", b"isom", bytes(4), b"isom") + body


def no_durations() -> bytes:
    """Return an mp4 whose frames last no time, in every header that says so."""
    content = film()
    for name, at in ((b"mvhd", 20), (b"tkhd", 24), (b"mdhd", 20), (b"stts", 16)):
        content = patched(content, name, at, bytes(4))
    return content


def _changed_size() -> bytes:
    return film("mpegts", "mpeg2video", 4, fps=25) + film("mpegts", "mpeg2video", 4, width=48, height=48, fps=25)


def _frames(codec: str, pixels: str, color: int, count: int = 4, container: str = "matroska") -> bytes:
    """Encode frames of one color and transparency."""
    file = io.BytesIO()
    with av.open(file, "w", format=container) as output:
        stream = output.add_stream(codec, 10)
        stream.width, stream.height, stream.pix_fmt = SIZE, SIZE, pixels
        for _ in range(count):
            output.mux(
                stream.encode(av.VideoFrame.from_ndarray(np.full((SIZE, SIZE, 4), color, np.uint8), format="rgba"))
            )
        output.mux(stream.encode(None))
    return file.getvalue()


def _empty_first() -> bytes:
    """Encode a subject that comes late."""
    file = io.BytesIO()
    with av.open(file, "w", format="matroska") as output:
        stream = output.add_stream("ffv1", 10)
        stream.width, stream.height, stream.pix_fmt = SIZE, SIZE, "bgra"
        for picture in [np.zeros((SIZE, SIZE, 4), np.uint8), *walk(3)]:
            output.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgba")))
        output.mux(stream.encode(None))
    return file.getvalue()


def _ebml(*parts: bytes) -> bytes:
    return b"\x1aE\xdf\xa3" + b"".join(parts)


def playlist_in_avi() -> bytes:
    """Return an AVI whose subtitle track is a playlist of a local file, as in CVE-2016-1897."""
    text = b"#EXTM3U\n#EXT-X-MEDIA-SEQUENCE:0\n#EXTINF:10.0,\nfile:///etc/passwd\n#EXT-X-ENDLIST\n"
    packet = b"GAB2\0\x02\0" + struct.pack("<I", 2) + b"s\0" + b"\x04\0" + struct.pack("<I", len(text)) + text
    content = film("avi", "mjpeg", pixels="yuvj420p")
    return content + b"01sb" + struct.pack("<I", len(packet)) + packet


def outside_data() -> bytes:
    """Return a QuickTime film whose data lie in another file, by an absolute path."""
    content = film("mov")
    return content.replace(b"url \0\0\0\x01", b"alis\0\0\0\0", 1).replace(b"url ", b"rsrc", 1)


def _blank_pixels() -> bytes:
    content = film()
    at = content.index(b"mdat")
    (size,) = struct.unpack_from(">I", content, at - 4)
    return content[: at + 4] + bytes(size - 8) + content[at - 4 + size :]


@functools.cache
def _coded() -> tuple[bytes, bytes]:
    """Return the configuration box and the picture of an HEVC intra frame."""
    content = film("mp4", "libx265", 1, options=X265, muxer=())
    at = content.index(b"hvcC") - 4
    (size,) = struct.unpack_from(">I", content, at)
    start = content.index(b"mdat") + 4
    (length,) = struct.unpack_from(">I", content, start - 8)
    return content[at : at + size], content[start : start + length - 8]


def heic(width: int = SIZE, height: int = SIZE) -> bytes:
    """Return a real HEIC picture."""
    config, payload = _coded()
    return heif(b"heic", b"hvc1", config, payload, width, height)


def _wide_avif() -> bytes:
    content = saved(subject("RGBA"), "AVIF")
    at = content.index(b"ispe") + 8
    return content[:at] + b"\xff" * 8 + content[at + 8 :]


VIDEOS: dict[str, Make] = {
    # mp4 and its kin
    "mp4: type alone": lambda: box(b"ftyp", b"isom", bytes(4), b"isom"),
    "mp4: zeros behind the type": lambda: b"\0\0\0\x18ftypmp42" + bytes(4000),
    "mp4: cut at a tenth": lambda: cut(film(), 0.1),
    "mp4: cut at three tenths": lambda: cut(film(), 0.3),
    "mp4: cut at six tenths": lambda: cut(film(), 0.6),
    "mp4: cut at nine tenths": lambda: cut(film(), 0.9),
    "mp4: one byte short": lambda: film()[:-1],
    "mp4: index alone": lambda: film()[: film().index(b"ftyp") + 28] + film()[film().index(b"moov") - 4 :],
    "mp4: pixels alone": lambda: box(b"mdat", bytes(4000)),
    "mp4: one frame": lambda: film(count=1),
    "mp4: no frame": lambda: patched(film(), b"stsz", 12, bytes(4)),
    "mp4: two billion samples": lambda: patched(film(), b"stsz", 12, struct.pack(">I", HUGE)),
    "mp4: four billion chunks": lambda: patched(film(), b"stco", 8, b"\xff" * 4),
    "mp4: chunks outside the file": lambda: patched(film(), b"stco", 12, struct.pack(">I", HUGE)),
    "mp4: a description of two billion entries": lambda: patched(film(), b"stsd", 8, struct.pack(">I", HUGE)),
    "mp4: 65,535 a side": lambda: patched(film(), b"avc1", 28, b"\xff" * 4),
    "mp4: no width": lambda: patched(film(codec="mpeg4"), b"mp4v", 28, bytes(4)),
    "mp4: unknown codec": lambda: film().replace(b"avc1\0\0\0\0\0\0", b"evil\0\0\0\0\0\0"),
    "mp4: encrypted": lambda: film().replace(b"avc1\0\0\0\0\0\0", b"encv\0\0\0\0\0\0"),
    "mp4: codec data of zeros": lambda: patched(film(), b"avcC", 4, bytes(16)),
    "mp4: pixels of zeros": _blank_pixels,
    "mp4: boxes 20,000 deep": lambda: nested(20_000),
    "mp4: boxes of no size": lambda: box(b"ftyp", b"isom", bytes(4)) + b"\0\0\0\x01moov" + bytes(8) + bytes(100),
    "mp4: a box of 2^63 bytes": lambda: (
        box(b"ftyp", b"isom", bytes(4)) + b"\0\0\0\x01moov\x7f" + b"\xff" * 7 + bytes(100)
    ),
    "mp4: boxes of 7 bytes": lambda: box(b"ftyp", b"isom", bytes(4)) + b"\0\0\0\x07moov" * 100,
    "mp4: sound alone": lambda: sound("mp4", "aac"),
    "mp4: 20 x 20": lambda: film(width=20, height=20),
    "mp4: 2,048 x 64": lambda: film(width=2048, height=64, count=2),
    "mp4: all of one color": lambda: _frames("libx264", "yuv420p", 0, container="mp4"),
    "mp4: every offset shifted": lambda: box(b"free", bytes(100)) + film(),
    "mp4: HEIC with nothing in it": lambda: b"\0\0\0\x18ftypheic" + bytes(64),
    "mp4: AVIF with nothing in it": lambda: b"\0\0\0\x18ftypavif" + bytes(64),
    "mp4: HEIC": heic,
    "mp4: AVIF": lambda: saved(subject("RGBA"), "AVIF"),
    "mp4: AVIF cut at a half": lambda: cut(saved(subject("RGBA"), "AVIF"), 0.5),
    "mp4: AVIF of four billion a side": _wide_avif,
    "mp4: moving AVIF": lambda: film("avif", "libsvtav1", options=(("preset", "12"),)),
    "mp4: HEIC of four billion a side": lambda: heic(2**32 - 1, 2**32 - 1),
    "mov: data in another file": outside_data,
    # other containers
    "mkv: header alone": lambda: film("matroska", "ffv1", pixels="bgra")[:40],
    "mkv: magic alone": lambda: b"\x1aE\xdf\xa3",
    "mkv: cut before the frames": lambda: film("matroska", "ffv1", pixels="bgra").split(b"\x1f\x43\xb6\x75")[0],
    "mkv: header of 2^56 bytes": lambda: _ebml(b"\x01" + b"\xff" * 7, bytes(100)),
    "mkv: elements 5,000 deep": lambda: _ebml(b"\x80", b"\x18\x53\x80\x67\xff" * 5000),
    "mkv: nothing visible": lambda: _frames("ffv1", "bgra", 0),
    "mkv: subject comes late": _empty_first,
    "webm: cut at a half, no frame whole": lambda: film("webm", "libvpx-vp9", 2)[:500],
    "avi: header alone": lambda: film("avi", "mjpeg", pixels="yuvj420p")[:60],
    "avi: no streams": lambda: riff(b"AVI ", (b"LIST", b"hdrl")),
    "avi: lists that lie": lambda: film("avi", "mjpeg", pixels="yuvj420p").replace(b"LIST", b"LIST\xff\xff\xff\x7f", 1),
    "flv: header alone": lambda: b"FLV\x01\x05\0\0\0\x09\0\0\0\0",
    "flv: tag of 16 MB": lambda: b"FLV\x01\x01\0\0\0\x09\0\0\0\0\x09\xff\xff\xff" + bytes(200),
    "ogg: sound alone": lambda: sound("ogg", "libopus"),
    "ogg: page without a stream": lambda: b"OggS\0\x02" + bytes(200),
    "mpeg: pack header alone": lambda: b"\0\0\x01\xba" + bytes(200),
    "ts: packets of nothing": lambda: (b"G\x1f\xff\x10" + b"\xff" * 184) * 50,
    "ts: changes its size": _changed_size,
    # sound
    "mp4: title in Latin-1": lambda: titled("mp4"),
    "mkv: title in Latin-1": lambda: titled("matroska"),
    "avi: title in Latin-1": lambda: titled("avi", "mjpeg", "yuvj420p"),
    "flv: key in Latin-1": lambda: film("flv", "flv").replace(b"encoder", b"enc\xffder"),
    "mp4: two frames": lambda: film(count=2),
    "mp4: no durations": no_durations,
    "mp4: no movie duration": lambda: patched(film(), b"mvhd", 20, bytes(4)),
    "mp4: a billion frames of times": lambda: patched(film(), b"stts", 12, struct.pack(">I", 2**30)),
    "mp4: turned by 90 degrees": lambda: turned(90),
    "mp4: turned by 180 degrees": lambda: turned(180),
    "mp4: turned by 270 degrees": lambda: turned(270),
    "mp4: fragments": lambda: film(muxer=(("movflags", "frag_keyframe+empty_moov"),)),
    "mp4: index first": lambda: film(muxer=(("movflags", "faststart"),)),
    "mp4: a frame every 1,000 s": lambda: film(fps=Fraction(1, 1000)),
    "mp4: 1,000 frames a second": lambda: film(fps=1000),
    "mp4: uneven sizes": lambda: film(pixels="yuv444p", width=65, height=47),
    "mp4: 10 bits": lambda: film(codec="libx265", pixels="yuv420p10le", options=X265),
    "mp4: AV1": lambda: film(codec="libsvtav1", options=(("preset", "12"),)),
    "mp4: 40 frames": lambda: film(count=40, width=160, height=160),
    "mp4: zip behind": lambda: film() + frames_zip(),
    "mov: ProRes with alpha": lambda: film("mov", "prores_ks", pixels="yuva444p10le", options=(("profile", "4"),)),
    "mkv: clusters of unknown size": lambda: film("matroska", "ffv1", pixels="bgra", muxer=(("live", "1"),)),
    "webm: VP9 with alpha": lambda: film("webm", "libvpx-vp9", pixels="yuva420p"),
    "avi: MJPEG": lambda: film("avi", "mjpeg", pixels="yuvj420p"),
    "avi: playlist as subtitles": playlist_in_avi,
    "avi: cut at nine tenths": lambda: cut(film("avi", "mjpeg", 8, pixels="yuvj420p"), 0.9),
    "flv: Sorenson": lambda: film("flv", "flv"),
    "mpeg: program stream": lambda: film("mpeg", "mpeg1video", fps=25),
    "ts: MPEG-2": lambda: film("mpegts", "mpeg2video", fps=25),
    "ts: begun in the middle": lambda: film("mpegts", "mpeg2video", 8, fps=25, options=(("g", "2"),))[188 * 3 :],
}


__all__: Iterable[str] = ["VIDEOS", "film", "flipped", "full_box", "heic", "sound"]
