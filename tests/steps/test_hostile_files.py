"""Files made to break whoever opens them: each is refused in a sentence, soon, and without the memory it asks for."""

import io
import struct
import time
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pytest

from dg4d_lib.errors import BadInput
from steps import clips
from steps.sources import Source, read_source


def read(folder: Path, content: bytes) -> Source:
    (folder / "file").write_bytes(content)
    return read_source(folder / "file", folder, 32)


def png(width: int, height: int) -> bytes:
    parts = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)),
        (b"IDAT", zlib.compress(bytes(64 * 65))),
        (b"IEND", b""),
    ]
    chunks = (struct.pack(">I", len(b)) + n + b + struct.pack(">I", zlib.crc32(n + b)) for n, b in parts)
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def tiff(width: int, height: int, channels: int = 1, rows: int = 64, tile: int = 0) -> bytes:
    """A header that promises much, and a thousand bytes of pixels."""
    tags = {256: width, 257: height, 258: 8, 259: 1, 262: 1, 277: channels}
    tags |= {322: tile, 323: tile, 324: 200, 325: 1000} if tile else {273: 200, 278: rows, 279: 1000}
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags.items())
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(1200)


def gif(width: int, height: int, frames: int) -> bytes:
    """An animation that repeats for ever, of frames of one byte."""
    head = b"GIF89a" + struct.pack("<HHBBB", width, height, 0x80, 0, 0) + b"\0\0\0\xff\xff\xff"
    forever = b"!\xff\x0bNETSCAPE2.0\x03\x01\0\0\0"
    frame = b"!\xf9\x04\0\x01\0\0\0," + struct.pack("<HHHHB", 0, 0, 64, 64, 0) + b"\x02\x02\x44\x01\0"
    return head + forever + frame * frames + b";"


def film(size: int, frames: int, container: str) -> bytes:
    file = io.BytesIO()
    with av.open(file, "w", format=container) as output:
        stream = output.add_stream("libx264", rate=24)
        stream.width = stream.height = size
        stream.pix_fmt = "yuv420p"
        for i in range(frames):
            picture = av.VideoFrame.from_ndarray(np.full((size, size, 3), i, np.uint8), format="rgb24")
            output.mux(stream.encode(picture))
        output.mux(stream.encode())
    return file.getvalue()


def patched(content: bytes, box: bytes, at: int, value: bytes) -> bytes:
    """An mp4 with other bytes in a box, counted from the box's name."""
    start = content.index(box, content.index(b"moov")) + at
    return content[:start] + value + content[start + len(value) :]


def frames_in_a_zip(count: int) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for i in range(count):
            archive.writestr(f"{i}.png", b"")
    return file.getvalue()


HUGE = 2**31 - 1
REFUSED: dict[str, Callable[[], bytes]] = {
    "a PNG of 60,000 pixels a side": lambda: png(60_000, 60_000),
    "a PNG of two billion pixels a side": lambda: png(HUGE, HUGE),
    "a TIFF of 100,000 pixels a side": lambda: tiff(100_000, 100_000),
    "a TIFF of 60,000 channels": lambda: tiff(64, 64, channels=60_000),
    "a TIFF of a tile of a million pixels a side": lambda: tiff(64, 64, tile=1_000_000),
    "a TIFF of two billion rows in a strip": lambda: tiff(64, HUGE, rows=HUGE),
    "a GIF of 65,535 pixels a side": lambda: gif(65_535, 65_535, 3),
    "a GIF of 20,000 frames": lambda: gif(64, 64, 20_000),
    "an mp4 of two billion samples": lambda: patched(film(64, 4, "mp4"), b"stsz", 12, struct.pack(">I", HUGE)),
    "a zip of 9,001 frames": lambda: frames_in_a_zip(9001),
}


@pytest.mark.parametrize("make", REFUSED.values(), ids=REFUSED)
def test_what_promises_too_much_is_refused_at_once(make: Callable[[], bytes], tmp_path: Path) -> None:
    content = make()
    assert len(content) < 2**20
    start = time.process_time()
    with pytest.raises(BadInput):
        read(tmp_path, content)
    assert time.process_time() - start < 5


def test_frames_that_the_header_invents_are_not_waited_for(tmp_path: Path) -> None:
    source = read(tmp_path, patched(film(64, 4, "mp4"), b"stts", 12, struct.pack(">I", 2**30)))
    assert len(source.frames) == 4
    assert "promises 1073741824 frames; 4 can be read" in source.notes[0]


def test_frames_that_grow_on_the_way_are_not_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clips, "MOST_PIXELS", 100 * 100)
    with pytest.raises(BadInput, match="cut off or broken"):
        read(tmp_path, film(64, 40, "mpegts") + film(512, 4, "mpegts"))
    assert len(read(tmp_path, film(64, 40, "mpegts")).frames) == 32


def test_many_large_frames_are_too_many_pixels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clips, "MOST_DECODED", 64 * 64 * 10)
    with pytest.raises(BadInput, match="pixels in all"):
        read(tmp_path, gif(64, 64, 11))
    assert len(read(tmp_path, gif(64, 64, 10)).frames) == 10


def test_a_video_that_takes_too_long_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clips, "MOST_DECODING_S", 0.0)
    with pytest.raises(BadInput, match="takes more than 0 s"):
        read(tmp_path, film(64, 4, "mp4"))


def test_a_video_without_durations_gets_a_rate(tmp_path: Path) -> None:
    content = patched(film(64, 4, "mp4"), b"stts", 12, struct.pack(">I", 0))
    for box, at in ((b"mvhd", 20), (b"mdhd", 20), (b"tkhd", 24)):
        content = patched(content, box, at, bytes(4))
    source = read(tmp_path, content)
    assert len(source.frames) >= 3  # FFmpeg takes one of the frames at the same moment for a repetition
    assert 1 <= source.fps <= 240


@pytest.mark.parametrize(("degrees", "matrix"), [(90, (0, 1, -1, 0)), (180, (-1, 0, 0, -1)), (270, (0, -1, 1, 0))])
def test_the_rotation_of_a_phone_is_undone(degrees: int, matrix: tuple[int, ...], tmp_path: Path) -> None:
    """The matrix of an mp4 turns clockwise; the stored upper left corner is dark."""
    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as output:
        stream = output.add_stream("libx264", rate=24)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        for _ in range(2):
            stored = np.full((64, 96, 3), 255, np.uint8)
            stored[:32, :48] = 0
            output.mux(stream.encode(av.VideoFrame.from_ndarray(stored, format="rgb24")))
        output.mux(stream.encode())
    a, b, c, d = (value << 16 for value in matrix)
    content = patched(file.getvalue(), b"tkhd", 44, struct.pack(">iiiiiiiii", a, b, 0, c, d, 0, 0, 0, 1 << 30))
    frames = read(tmp_path, content).frames
    upright = np.rot90(stored, -degrees // 90)
    assert frames.shape[1:3] == upright.shape[:2]
    assert np.abs(frames[0, ..., :3].numpy() - upright / 255).mean() < 0.05
