"""Display matrices and frame times of videos and animations."""

import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from media_files import save_clip, walk
from PIL import Image

from steps.sources.reader import Source, read_source

WIDTH, HEIGHT = 96, 64
QUARTERS = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
QUARTERS[:32, :48] = (200, 40, 30, 255)
QUARTERS[:32, 48:] = (40, 180, 60, 255)
QUARTERS[32:, :48] = (40, 60, 200, 255)
QUARTERS[32:, 48:] = (128, 128, 128, 255)
MATRIX_AT = 44  # bytes from the name of the box tkhd, version 0, to its matrix


def read(path: Path) -> Source:
    return read_source(path, path.parent, 8)


@pytest.fixture(scope="module")
def upright(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("upright") / "a.mp4"
    return save_clip(path, [QUARTERS] * 2, "libx264", "yuv420p").read_bytes()


@pytest.mark.parametrize(
    ("matrix", "shown"),  # where columns and rows go, and the move back into the picture
    [
        ((1, 0, 0, 1, 0, 0), QUARTERS),
        ((0, 1, -1, 0, HEIGHT, 0), np.rot90(QUARTERS, -1)),
        ((-1, 0, 0, -1, WIDTH, HEIGHT), np.rot90(QUARTERS, 2)),
        ((0, -1, 1, 0, 0, WIDTH), np.rot90(QUARTERS)),
        ((-1, 0, 0, 1, WIDTH, 0), QUARTERS[:, ::-1]),
        ((1, 0, 0, -1, 0, HEIGHT), QUARTERS[::-1]),
        ((0, 1, 1, 0, 0, 0), QUARTERS.transpose(1, 0, 2)),
        ((0, -1, -1, 0, HEIGHT, WIDTH), np.rot90(QUARTERS, 2).transpose(1, 0, 2)),
    ],
    ids=["none", "90", "180", "270", "mirrored", "upside down", "transposed", "transverse"],
)
def test_a_video_is_turned_and_mirrored_as_players_show_it(tmp_path, upright, matrix, shown):
    at = upright.index(b"tkhd") + MATRIX_AT
    a, b, c, d, x, y = (round(value * 2**16) for value in matrix)
    content = upright[:at] + struct.pack(">9i", a, b, 0, c, d, 0, x, y, 2**30) + upright[at + 36 :]
    (tmp_path / "a.mp4").write_bytes(content)
    source = read(tmp_path / "a.mp4")
    assert source.size == shown.shape[1::-1] == source.frames.shape[2:0:-1]
    assert (source.frames[0] - torch.from_numpy(shown / 255)).abs().mean() < 0.02


@pytest.mark.parametrize(("duration_ms", "fps"), [(0, 10), (10, 10), (20, 50), (40, 25)])
@pytest.mark.parametrize("suffix", [".gif", ".webp", ".apng"])
def test_frames_without_a_duration_are_as_slow_as_in_browsers(tmp_path, suffix, duration_ms, fps):
    frames = [Image.fromarray(frame) for frame in walk(4)]
    kind = {".apng": "PNG"}.get(suffix, suffix[1:].upper())
    options = {"save_all": True, "append_images": frames[1:], "duration": duration_ms}
    frames[0].save(tmp_path / f"a{suffix}", kind, **options)
    assert read(tmp_path / f"a{suffix}").fps == pytest.approx(fps, rel=1e-3)
