"""Videos that are right and unusual: what is done with them, beyond that they are read."""

import os
import struct
from pathlib import Path

import numpy as np
import pytest

from steps.sources.reader import Source, read_source
from tests.hostile.formats import opaque, patched
from tests.hostile.videos import VIDEOS, film, no_durations, walk


def read(folder: Path, content: bytes) -> Source:
    (folder / "file").write_bytes(content)
    return read_source(folder / "file", folder, 32)


def test_a_video_without_durations_gets_a_rate(tmp_path: Path) -> None:
    source = read(tmp_path, no_durations())
    assert len(source.frames) >= 3  # FFmpeg takes one of the frames at the same moment for a repetition
    assert 1 <= source.fps <= 240


@pytest.mark.parametrize(("degrees", "matrix"), [(90, (0, 1, -1, 0)), (180, (-1, 0, 0, -1)), (270, (0, -1, 1, 0))])
def test_the_rotation_of_a_phone_is_undone(degrees: int, matrix: tuple[int, ...], tmp_path: Path) -> None:
    a, b, c, d = (value << 16 for value in matrix)
    turn = struct.pack(">iiiiiiiii", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    frames = read(tmp_path, patched(film(width=64, height=48), b"tkhd", 44, turn)).frames
    upright = np.rot90(opaque(walk(1)[0])[:48], -degrees // 90)
    assert frames.shape[1:3] == upright.shape[:2]
    assert np.abs(frames[0, ..., :3].numpy() - upright / 255).mean() < 0.05  # the loss of the codec


def test_encoding_av1_leaves_the_scheduling_of_this_process() -> None:
    before = os.sched_getscheduler(0)
    assert VIDEOS["mp4: AV1"]()
    assert os.sched_getscheduler(0) == before
