"""Windows and layers of OpenEXR files."""

import zipfile
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from numpy import ndarray
from PIL import Image

from dg4d_lib.errors import BadInput
from steps.sources import stills
from steps.sources.decode_limit import DecodeLimit
from steps.sources.masks import read_mask
from steps.sources.reader import Source, read_source
from steps.sources.stills import read_values

RED, BLUE = (0.5, 0.0, 0.0), (0.0, 0.0, 0.5)  # linear
SHOWN = (128, 96)  # width and height of the display window
ORIGIN = (-7, 3)  # first column and row of the display window


def read(path: Path) -> Source:
    return read_source(path, path.parent, 8)


def save(path: Path, pixels: ndarray, names: str, at: tuple[int, int] = (0, 0), tile: int = 0) -> Path:
    """Write an EXR whose data window begins `at` so many columns and rows from its display window."""
    height, width, count = pixels.shape
    spec = oiio.ImageSpec(width, height, count, "float")
    spec.channelnames, spec.alpha_channel = tuple(names.split()), -1
    spec.x, spec.y = ORIGIN[0] + at[0], ORIGIN[1] + at[1]
    spec.full_x, spec.full_y = ORIGIN
    spec.full_width, spec.full_height = SHOWN
    spec.tile_width = spec.tile_height = tile
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec), output.geterror()
    assert output.write_image(np.ascontiguousarray(pixels, np.float32)) and output.close(), output.geterror()
    return path


def flat(width: int, height: int, *values: float) -> ndarray:
    return np.broadcast_to(np.array(values, np.float32), (height, width, len(values)))


def covered(source: Source, frame: int = 0) -> tuple[int, int, int, int]:
    """Return left, top, right and bottom of the pixels that are not transparent."""
    rows, columns = (source.frames[frame, ..., 3] > 0.5).nonzero().unbind(1)
    return int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1


def test_frames_with_data_windows_keep_their_motion(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for i in range(4):
            path = save(tmp_path / "frame.exr", flat(40, 40, *RED, 1), "R G B A", (10 + 20 * i, 20))
            archive.write(path, f"{i}.exr")
    source = read(tmp_path / "a.zip")
    assert source.size == SHOWN and source.frames.shape == (4, 96, 128, 4) and source.has_alpha
    assert [covered(source, i) for i in range(4)] == [(10 + 20 * i, 20, 50 + 20 * i, 60) for i in range(4)]
    assert not source.frames[0, :, 60:].any()


@pytest.mark.parametrize("tile", [0, 32])
@pytest.mark.parametrize(
    ("at", "expected"),
    [
        ((-30, -20), (0, 0, 70, 60)),
        ((60, 40), (60, 40, 128, 96)),
        ((-10, 90), (0, 90, 90, 96)),
        ((0, 0), (0, 0, 100, 80)),
    ],
)
def test_pixels_outside_of_the_display_window_are_cropped(tmp_path, monkeypatch, at, expected, tile):
    monkeypatch.setattr(stills, "BAND_BYTES", 2**12)  # bands of a few rows
    pixels = np.ones((80, 100, 4), np.float32)
    pixels[..., 0], pixels[..., 1] = np.mgrid[:80, :100] / 100
    source = read(save(tmp_path / "a.exr", pixels, "R G B A", at, tile))
    assert source.size == SHOWN and covered(source) == expected
    left, top, right, bottom = expected
    truth = torch.from_numpy(pixels[top - at[1] : bottom - at[1], left - at[0] : right - at[0], :2])
    curve = torch.where(truth <= 0.0031308, 12.92 * truth, 1.055 * truth ** (1 / 2.4) - 0.055)
    torch.testing.assert_close(source.frames[0, top:bottom, left:right, :2], curve, atol=1e-4, rtol=0)


@pytest.mark.parametrize("at", [(-200, 0), (128, 0), (0, -90), (0, 96)])
def test_a_data_window_beside_the_display_window_shows_nothing(tmp_path, at):
    source = read(save(tmp_path / "a.exr", flat(40, 40, *RED, 1), "R G B A", at))
    assert source.size == SHOWN and not source.frames.any()


def test_a_tiny_data_window_is_read(tmp_path):
    assert covered(read(save(tmp_path / "a.exr", flat(1, 1, *RED, 1), "R G B A", (5, 6)))) == (5, 6, 6, 7)


def test_outside_of_the_data_window_a_picture_without_alpha_is_black(tmp_path):
    source = read(save(tmp_path / "a.exr", flat(40, 40, *RED), "R G B", (10, 20)))
    assert not source.has_alpha
    assert source.frames[0, 30, 20, 0] > 0.5 and source.frames[0, 5, 5].tolist() == [0, 0, 0, 1]


def test_a_mask_has_the_size_of_the_display_window(tmp_path):
    source = read(save(tmp_path / "a.exr", flat(40, 40, *RED, 1), "R G B A", (10, 20)))
    Image.new("L", SHOWN, 255).save(tmp_path / "mask.png")
    assert read_mask(tmp_path / "mask.png", source, tmp_path, 8, 1.0).shape == (1, 96, 128)


def test_depth_outside_of_the_data_window_is_unknown(tmp_path):
    path = save(tmp_path / "a.exr", flat(40, 40, 3), "Z", (10, 20))
    values = read_values(path, "the depth picture", DecodeLimit(1.0), 96, 128)
    assert values.size == SHOWN and values.known.sum() == 40 * 40 and values.known[20:60, 10:50].all()
    assert (values.values[values.known] == 3).all()


def test_the_limits_count_both_windows(tmp_path, monkeypatch):
    path = save(tmp_path / "a.exr", flat(40, 40, *RED, 1), "R G B A", (10, 20))
    with pytest.raises(BadInput, match=r"the picture is 128 x 96 pixels and takes"):
        stills.read_still(path, "the picture", DecodeLimit(2e-4))
    monkeypatch.setattr(stills, "MOST_PIXELS", 128 * 96 - 1)
    with pytest.raises(BadInput, match=r"128 x 96 pixels; at most"):
        read(path)
    monkeypatch.setattr(stills, "MOST_PIXELS", 128 * 96)
    large = save(tmp_path / "b.exr", flat(130, 96, *RED, 1), "R G B A")
    with pytest.raises(BadInput, match=r"stores 130 x 96 pixels in its data window"):
        read(large)
    monkeypatch.undo()
    wide = save(tmp_path / "c.exr", flat(4096, 4, *RED, 1), "R G B A")
    with pytest.raises(BadInput, match=r"the picture is 4096 x 4 pixels and takes"):
        stills.read_still(wide, "the picture", DecodeLimit(2e-4))


COMBINED = "View.Combined.R View.Combined.G View.Combined.B"


@pytest.mark.parametrize(
    ("names", "values", "layer"),
    [
        (
            f"View.AO.R View.AO.G View.AO.B {COMBINED} View.Combined.A View.Depth.Z",
            (*BLUE, *RED, 1, 5),
            "View.Combined",
        ),
        (f"View.AO.R View.AO.G View.AO.B {COMBINED} View.Depth.Z", (*BLUE, *RED, 5), "View.Combined"),
        ("Diffuse.R Diffuse.G Diffuse.B Beauty.R Beauty.G Beauty.B", (*BLUE, *RED), "Beauty"),
        ("AO.R AO.G AO.B Own.R Own.G Own.B Own.A", (*BLUE, *RED, 1), "Own"),
        ("Here.R Here.G Here.B There.R There.G There.B", (*RED, *BLUE), "Here"),
        (f"{COMBINED} View.Depth.Z View.Normal.X View.Normal.Y View.Normal.Z", (*RED, 5, 0, 0, 1), ""),
        ("R G B Crypto00.r Crypto00.g Crypto00.b Crypto00.a", (*RED, *BLUE, 0), ""),
        ("R G B A N.X N.Y N.Z", (*RED, 1, 0, 0, 1), ""),
    ],
)
def test_colors_and_alpha_are_those_of_one_layer(tmp_path, names, values, layer):
    source = read(save(tmp_path / "a.exr", flat(*SHOWN, *values), names))
    torch.testing.assert_close(source.frames[0, 30, 30], torch.tensor([0.7354, 0, 0, 1]), atol=1e-3, rtol=0)
    assert [f"'{layer}'" in note for note in source.notes] == [True] * bool(layer)


def test_layers_of_colors_have_the_alpha_beside_them(tmp_path):
    path = save(tmp_path / "a.exr", flat(*SHOWN, 0.25, 0, 0, 0.5), "View.R View.G View.B A")
    source = read(path)
    torch.testing.assert_close(source.frames[0, 30, 30], torch.tensor([0.7354, 0, 0, 0.5]), atol=1e-3, rtol=0)


def test_depth_is_read_beside_layers_of_colors(tmp_path):
    names = f"View.AO.R View.AO.G View.AO.B {COMBINED} View.Combined.A View.Depth.Z"
    path = save(tmp_path / "a.exr", flat(*SHOWN, *BLUE, *RED, 1, 5), names)
    values = read_values(path, "the depth picture", DecodeLimit(1.0), 96, 128)
    assert values.known.all() and (values.values == 5).all()
