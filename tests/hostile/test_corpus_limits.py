"""Limits of number, size and time, which a file of a few kilobytes cannot reach: they are lowered instead."""

from pathlib import Path

import pytest

from dg4d_lib.errors import BadInput
from steps.sources import clips
from steps.sources.reader import Source, read_source
from tests.hostile.formats import gif
from tests.hostile.videos import VIDEOS, film


def read(folder: Path, content: bytes) -> Source:
    (folder / "file").write_bytes(content)
    return read_source(folder / "file", folder, 32)


def test_frames_that_the_header_invents_are_not_waited_for(tmp_path: Path) -> None:
    source = read(tmp_path, VIDEOS["mp4: a billion frames of times"]())
    assert len(source.frames) == 4
    assert "declares 1073741824 frames; 4 can be read" in source.notes[0]


def test_frames_that_grow_on_the_way_are_not_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clips, "MOST_PIXELS", 100 * 100)
    small = film("mpegts", count=40)
    with pytest.raises(BadInput, match="cut off or broken"):
        read(tmp_path, small + film("mpegts", width=512, height=512))
    assert len(read(tmp_path, small).frames) == 32


def test_many_large_frames_are_too_many_pixels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clips, "MOST_DECODED", 64 * 64 * 10)
    with pytest.raises(BadInput, match="pixels in all"):
        read(tmp_path, gif(11))
    assert len(read(tmp_path, gif(10)).frames) == 10


def test_a_video_that_takes_too_long_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clips, "MOST_DECODING_S", 0.0)
    with pytest.raises(BadInput, match="takes more than 0 s"):
        read(tmp_path, film())
