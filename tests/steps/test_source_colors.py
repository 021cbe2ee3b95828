"""Colors of pictures and videos that are not stored as straight sRGB."""

from pathlib import Path

import numpy as np
import pytest
import torch
from media_files import disc, save, save_clip
from PIL import Image, ImageCms, PngImagePlugin

from dg4d_lib.errors import BadInput
from steps.sources.color_profiles import LARGEST_PROFILE, convert_to_srgb
from steps.sources.reader import Source, read_source


def read(path: Path) -> Source:
    return read_source(path, path.parent, 32)


def profile(space: str = "sRGB") -> bytes:
    return ImageCms.ImageCmsProfile(ImageCms.createProfile(space)).tobytes()


def exchanged() -> bytes:
    """Profile of sRGB whose red is green, and whose green is red."""
    return profile().replace(b"rXYZ", b"xXYZ").replace(b"gXYZ", b"rXYZ").replace(b"xXYZ", b"gXYZ")


@pytest.mark.parametrize("suffix", [".png", ".tif", ".jpg", ".webp", ".avif"])
def test_colors_of_a_profile_become_srgb(tmp_path, suffix):
    image = Image.fromarray(disc()).convert("RGB" if suffix == ".jpg" else "RGBA")
    options = {".webp": {"lossless": True}, ".avif": {"quality": 100, "subsampling": "4:4:4"}}
    image.save(tmp_path / f"a{suffix}", icc_profile=exchanged(), **options.get(suffix, {}))
    source = read(tmp_path / f"a{suffix}")
    expected = torch.tensor([60 / 255, 200 / 255, 30 / 255, 1.0])
    torch.testing.assert_close(source.frames[0, 32, 28], expected, atol=0.03, rtol=0)
    assert source.has_alpha == (suffix != ".jpg") and source.notes == ()


@pytest.mark.parametrize(
    ("content", "is_noted"),
    [
        (b"", False),
        (profile(), False),
        (profile("LAB"), False),
        (b"no profile at all", True),
        (exchanged()[:300], True),
        (exchanged().replace(b"RGB ", b"R\xffB ", 1), True),
        (exchanged() + bytes(LARGEST_PROFILE), True),
    ],
    ids=["none", "sRGB", "Lab", "text", "cut off", "space is not ASCII", "huge"],
)
def test_profiles_of_srgb_and_those_that_cannot_be_used_change_no_color(content, is_noted):
    picture = torch.rand(40, 40, 4, generator=torch.Generator().manual_seed(0))
    before = picture.clone()
    assert bool(convert_to_srgb(picture, content)) == is_noted
    assert torch.equal(picture, before)


def test_a_broken_profile_of_a_picture_is_noted(tmp_path):
    Image.fromarray(disc()).convert("RGB").save(tmp_path / "a.jpg", icc_profile=b"no profile at all")
    assert any("color profile" in note for note in read(tmp_path / "a.jpg").notes)


def test_a_tiff_with_lab_colors_is_refused_by_name(tmp_path):
    Image.new("LAB", (40, 40), (255, 0, 0)).save(tmp_path / "a.tif")  # white, which libtiff makes yellow
    with pytest.raises(BadInput, match="TIFF with Lab colors"):
        read(tmp_path / "a.tif")


def test_a_comment_with_the_name_of_a_profile_is_none(tmp_path):
    info = PngImagePlugin.PngInfo()
    info.add_text("ICCProfile", "a comment")
    Image.fromarray(disc()).save(tmp_path / "a.png", pnginfo=info)
    assert read(tmp_path / "a.png").notes == ()


@pytest.mark.parametrize("is_straight", [True, False])
@pytest.mark.parametrize(("form", "expected"), [("uint8", 0.8), ("uint16", 0.8), ("float", 0.9063)])  # sRGB of 0.8
def test_a_tiff_says_if_its_colors_are_multiplied_by_alpha(tmp_path, form, expected, is_straight):
    picture = np.full((64, 64, 4), 0.8, np.float32)
    picture[..., 3] = 0.5
    if not is_straight:
        picture[..., :3] *= 0.5
    path = save(tmp_path / "a.tif", picture, form, **{"oiio:UnassociatedAlpha": int(is_straight)})
    frame = read(path).frames[0]
    torch.testing.assert_close(frame[32, 32], torch.tensor([expected] * 3 + [0.5]), atol=0.01, rtol=0)


@pytest.mark.parametrize(
    ("curve", "color", "expected"),
    [
        (18, (191, 191, 191), (255, 255, 255)),  # HLG: diffuse white is 75 % of the signal, by BT.2408
        pytest.param(16, (148, 148, 148), (255, 255, 255), marks=pytest.mark.slow),  # PQ: 58 %
        pytest.param(14, (172, 136, 132), (191, 130, 130), marks=pytest.mark.slow),  # linear sRGB 0.5, 0.2, 0.2
    ],
)
def test_hdr_and_wide_gamut_videos_become_srgb(tmp_path, curve, color, expected):
    frames = [np.full((32, 32, 4), (*color, 255), np.uint8)] * 2
    header = {"color_trc": curve, "color_primaries": 9, "colorspace": 0}
    source = read(save_clip(tmp_path / "a.mkv", frames, "ffv1", "gbrp10le", header=header))
    torch.testing.assert_close(source.frames[1, 16, 16, :3] * 255, torch.tensor(expected).float(), atol=4, rtol=0)
    assert any("converted to sRGB" in note for note in source.notes)
