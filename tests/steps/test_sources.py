import zipfile
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
from media_files import (
    disc,
    opaque,
    png_header,
    save,
    save_clip,
    save_palette,
    save_zip,
    walk,
)
from PIL import Image

from dg4d_lib.errors import BadInput
from steps.sources.clips import sampled_frames, thinned_rate, work_side
from steps.sources.media_types import check_media
from steps.sources.reader import Source, read_source

COLOR = torch.tensor((200, 60, 30)) / 255


def read(path: Path, max_frames: int = 32) -> Source:
    """Under the name that a store gives it: content only, no suffix."""
    anonymous = path.with_name("source")
    anonymous.write_bytes(path.read_bytes())
    scratch = path.with_name("scratch")
    scratch.mkdir(exist_ok=True)
    return read_source(anonymous, scratch, max_frames)


def assert_shows_disc(source: Source, tolerance: float = 0.01, has_alpha: bool = True) -> None:
    assert source.kind == "picture"
    assert source.frames.shape == (1, 64, 64, 4)
    assert source.has_alpha == has_alpha
    torch.testing.assert_close(source.frames[0, 32, 28, :3], COLOR, atol=tolerance, rtol=0)
    assert source.frames[0, 32, 28, 3] == 1
    assert source.frames[0, 2, 2, 3] == (0 if has_alpha else 1)


# Formats that must work


@pytest.mark.parametrize("suffix", [".png", ".tif", ".webp"])
def test_a_cutout_keeps_its_color_and_alpha(tmp_path, suffix):
    assert_shows_disc(read(save(tmp_path / f"a{suffix}", disc())), 0.04 if suffix == ".webp" else 0.002)


def test_sixteen_bits_are_read(tmp_path):
    assert_shows_disc(read(save(tmp_path / "a.png", disc().astype(np.uint16) * 257, "uint16")), 0.001)


def test_a_palette_with_transparency_is_read(tmp_path):
    assert_shows_disc(read(save_palette(tmp_path / "a.png", disc())), 0.001)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif"])
def test_opaque_pictures_say_that_they_have_no_alpha(tmp_path, suffix):
    assert_shows_disc(read(save(tmp_path / f"a{suffix}", opaque(disc()))), 0.03, has_alpha=False)


def test_an_alpha_channel_that_is_opaque_everywhere_says_nothing(tmp_path):
    picture = disc()
    picture[..., 3] = 255
    assert not read(save(tmp_path / "a.png", picture)).has_alpha


def test_grey_is_repeated_over_the_colors(tmp_path):
    source = read(save(tmp_path / "a.png", disc(color=(90, 90, 90))[..., :1]))
    torch.testing.assert_close(source.frames[0, 32, 28], torch.tensor([90 / 255] * 3 + [1.0]))
    assert not source.has_alpha


def test_grey_with_alpha_keeps_its_alpha(tmp_path):
    source = read(save(tmp_path / "a.png", disc(color=(90, 90, 90))[..., [0, 3]]))
    assert source.has_alpha and source.frames[0, 2, 2, 3] == 0
    torch.testing.assert_close(source.frames[0, 32, 28], torch.tensor([90 / 255] * 3 + [1.0]))


def test_cmyk_is_turned_into_rgb(tmp_path):
    image = pytest.importorskip("PIL.Image", reason="Pillow writes CMYK JPEG; it comes with scikit-image")
    ink = np.zeros((64, 64, 4), np.uint8)
    ink[16:48, 16:48] = (0, 255, 255, 0)  # magenta and yellow: red
    image.fromarray(ink, "CMYK").save(tmp_path / "a.jpg", quality=95)
    frame = read(tmp_path / "a.jpg").frames[0]
    torch.testing.assert_close(frame[32, 32], torch.tensor([1.0, 0.0, 0.0, 1.0]), atol=0.03, rtol=0)
    torch.testing.assert_close(frame[4, 4], torch.ones(4), atol=0.03, rtol=0)


def test_linear_light_becomes_srgb_and_color_loses_its_alpha(tmp_path):
    picture = np.zeros((64, 64, 4), np.float32)
    picture[16:48, 16:48] = (0.25 * 0.5, 0.5, 0.0, 0.5)  # multiplied by alpha, as OpenEXR wants it
    frame = read(save(tmp_path / "a.exr", picture, "half")).frames[0]
    expected = torch.tensor([0.5371, 1.0, 0.0, 0.5])  # sRGB of 0.25 is 1.055 * 0.25 ** (1 / 2.4) - 0.055
    torch.testing.assert_close(frame[32, 32], expected, atol=1e-3, rtol=0)


def test_what_is_not_a_number_becomes_black(tmp_path):
    picture = np.full((64, 64, 3), np.nan, np.float32)
    assert read(save(tmp_path / "a.exr", picture, "float")).frames[..., :3].eq(0).all()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_undone(tmp_path, orientation):
    upright = np.zeros((40, 64, 3), np.uint8)
    upright[:20, :32], upright[:20, 32:], upright[20:, :32] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    stored = {  # what a camera writes so that the named rule of EXIF gives the upright picture
        1: upright,
        2: upright[:, ::-1],
        3: upright[::-1, ::-1],
        4: upright[::-1],
        5: upright.transpose(1, 0, 2),
        6: np.rot90(upright, 1),
        7: upright[::-1, ::-1].transpose(1, 0, 2),
        8: np.rot90(upright, -1),
    }[orientation]
    frame = read(save(tmp_path / "a.jpg", stored, Orientation=orientation)).frames[0, ..., :3]
    assert frame.shape[:2] == (40, 64)
    for row, column, color in ((8, 8, (1, 0, 0)), (8, 56, (0, 1, 0)), (32, 8, (0, 0, 1)), (32, 56, (0, 0, 0))):
        torch.testing.assert_close(frame[row, column], torch.tensor(color).float(), atol=0.05, rtol=0)


def test_large_pictures_are_shrunk_and_keep_their_shape(tmp_path):
    assert read(save(tmp_path / "a.png", np.zeros((1500, 3000, 3), np.uint8))).frames.shape == (1, 1024, 2048, 4)


# Videos


@pytest.mark.parametrize(
    ("name", "codec", "pixels", "options"),
    [
        ("a.webm", "libvpx-vp9", "yuva420p", {}),
        ("b.webm", "libvpx", "yuva420p", {"auto-alt-ref": "0"}),
        ("a.mov", "prores_ks", "yuva444p10le", {"profile": "4"}),
        ("b.mov", "png", "rgba", {}),
        ("a.mkv", "ffv1", "bgra", {}),
        ("a.apng", "apng", "rgba", {}),
        ("a.webp", "libwebp_anim", "bgra", {"lossless": "1"}),
    ],
)
def test_alpha_of_videos_is_read(tmp_path, name, codec, pixels, options):
    source = read(save_clip(tmp_path / name, walk(5), codec, pixels, **options))
    assert source.kind == "video" and source.has_alpha and source.frames.shape == (5, 64, 64, 4)
    assert source.fps == pytest.approx(10, rel=1e-3) or name == "a.webp"
    for i, truth in enumerate(walk(5)):
        error = (source.frames[i, ..., 3] - torch.from_numpy(truth[..., 3] / 255)).abs().mean()
        assert error < 0.02, f"frame {i}: alpha is off by {error:.3f}"
    torch.testing.assert_close(source.frames[2, 32, 26, :3], COLOR, atol=0.06, rtol=0)


def test_transparency_of_a_gif_is_read(tmp_path):
    image = pytest.importorskip("PIL.Image", reason="Pillow writes GIF with transparency; it comes with scikit-image")
    frames = [image.fromarray(frame) for frame in walk(4)]
    frames[0].save(tmp_path / "a.gif", save_all=True, append_images=frames[1:], duration=200, disposal=2, loop=0)
    source = read(tmp_path / "a.gif")
    assert source.has_alpha and source.kind == "video" and source.fps == pytest.approx(5)
    for i, truth in enumerate(walk(4)):
        assert torch.equal(source.frames[i, ..., 3], torch.from_numpy(truth[..., 3] / 255).float())


def test_frames_of_an_animated_webp_that_cover_only_a_part_are_put_in_place(tmp_path):
    image = pytest.importorskip("PIL.Image", reason="Pillow optimizes WebP frames; it comes with scikit-image")
    frames = [image.fromarray(frame) for frame in walk(4)]
    options = {"save_all": True, "append_images": frames[1:], "duration": 80, "lossless": True}
    frames[0].save(tmp_path / "a.webp", minimize_size=True, **options)
    source = read(tmp_path / "a.webp")
    assert source.fps == pytest.approx(12.5)
    for i, truth in enumerate(walk(4)):
        assert torch.equal(source.frames[i, ..., 3], torch.from_numpy(truth[..., 3] / 255).float())


def test_an_mp4_is_opaque(tmp_path):
    source = read(
        save_clip(tmp_path / "a.mp4", [np.dstack([opaque(f), f[..., 3:]]) for f in walk(6)], "libx264", "yuv420p")
    )
    assert source.kind == "video" and not source.has_alpha and len(source.frames) == 6


def test_a_still_gif_is_a_picture(tmp_path):
    assert read(save_clip(tmp_path / "a.gif", walk(1), "gif", "rgb8")).kind == "picture"


@pytest.mark.parametrize("count", [1, 3])
def test_a_gif_that_ends_anywhere_within_its_first_frame_is_refused(tmp_path, count):
    whole = save_clip(tmp_path / "a.gif", walk(count), "gif", "rgb8").read_bytes()
    second = whole.index(b"\0!\xf9", whole.index(b",")) + 1 if count > 1 else len(whole) - 1
    for length in (*range(12, second, 7), second - 1):
        (tmp_path / "a.gif").write_bytes(whole[:length])
        with pytest.raises(BadInput, match="cut off or broken"):
            read(tmp_path / "a.gif")
    (tmp_path / "a.gif").write_bytes(whole[:second])
    assert read(tmp_path / "a.gif").kind == "picture"


def test_a_long_video_is_sampled_with_its_ends_and_its_speed(tmp_path):
    source = read(save_clip(tmp_path / "a.mkv", walk(11), "ffv1", "bgra"), max_frames=6)
    assert len(source.frames) == 6
    for kept, truth in zip(source.frames, walk(11)[::2], strict=True):
        assert torch.equal(kept[..., 3], torch.from_numpy(truth[..., 3] / 255).float())
    assert source.fps == pytest.approx(5)
    assert "6 of the video's 11 frames are used, evenly spaced; they play at the same speed." in source.notes


@pytest.mark.parametrize(("count", "most", "stride"), [(32, 16, 2), (4, 2, 2), (96, 32, 3), (512, 32, 16)])
def test_samples_have_one_distance_where_their_number_divides(count, most, stride):
    assert sampled_frames(count, most) == list(range(0, count, stride))
    assert thinned_rate(24.0, count, most) == pytest.approx(24.0 / stride)


@pytest.mark.parametrize(("count", "most"), [(2, 2), (5, 2), (31, 16), (31, 32), (33, 32), (1000, 7)])
def test_samples_are_distinct_and_hold_both_ends(count, most):
    chosen = sampled_frames(count, most)
    assert chosen == sorted(set(chosen)) and len(chosen) == min(count, most)
    assert chosen[0] == 0 and chosen[-1] == count - 1


def test_thinning_keeps_the_time_between_the_first_and_the_last_frame():
    assert (6 - 1) / thinned_rate(24.0, 31, 6) == pytest.approx((31 - 1) / 24.0)


def test_many_frames_share_a_bounded_amount_of_memory():
    assert work_side(32) == 1024 and 512 * work_side(512) ** 2 <= 32 * 1024**2


def test_wide_frames_are_shrunk_while_they_are_decoded(tmp_path):
    wide = [np.zeros((360, 1440, 4), np.uint8)] * 2
    assert read(save_clip(tmp_path / "a.mp4", wide, "libx264", "yuv420p")).frames.shape == (2, 256, 1024, 4)


@pytest.mark.parametrize(("codec", "pixels"), [("png", "rgba"), ("libx264", "yuv444p")])
def test_frames_of_wide_pixels_are_as_wide_as_players_show_them(tmp_path, codec, pixels):
    narrow = [frame[:, ::2] for frame in walk(3)]
    path = save_clip(tmp_path / "a.mov", narrow, codec, pixels, header={"sample_aspect_ratio": Fraction(2)})
    source = read(path)
    assert source.frames.shape == (3, 64, 64, 4) and source.size == (64, 64)
    inside = (source.frames[0, ..., 1] < 0.6) & (source.frames[0, ..., 3] > 0.5)
    assert int(inside.any(0).sum()) == pytest.approx(32, abs=2) == int(inside.any(1).sum())
    if source.has_alpha:  # nothing of the white around it
        torch.testing.assert_close(source.frames[0][source.frames[0, ..., 3] > 0.1][:, :3].amax(0), COLOR)


@pytest.mark.parametrize(("durations", "is_uneven"), [((2000, 50, 50, 50), True), ((90, 110, 90, 2000), False)])
@pytest.mark.parametrize("suffix", [".gif", ".webp", ".apng"])
def test_frames_that_are_held_are_noted(tmp_path, suffix, durations, is_uneven):
    frames = [Image.fromarray(opaque(frame)) for frame in walk(4)]
    options = {"PNG": {}, "WEBP": {"lossless": True}, "GIF": {}}
    kind = {".apng": "PNG"}.get(suffix, suffix[1:].upper())
    path = tmp_path / f"a{suffix}"
    frames[0].save(path, kind, save_all=True, append_images=frames[1:], duration=durations, **options[kind])
    source = read(path)
    assert source.fps == pytest.approx(3000 / sum(durations[:3]), rel=1e-3)  # how long the last is held says nothing
    assert any("uneven" in note for note in source.notes) == is_uneven


# Folders of frames


def test_frames_of_a_folder_are_ordered_by_number(tmp_path):
    names = ["walk_2.png", "walk_10.png", "walk_9.png", "walk_3.png", "walk_4.png", "walk_5.png"]
    names += ["walk_6.png", "walk_7.png", "walk_8.png"]
    entries = {name: disc(int(name[5:-4]) * 2) for name in names} | {"__MACOSX/._walk_2.png": disc()}
    source = read(save_zip(tmp_path / "a.zip", entries, tmp_path))
    left = [(frame[..., 3] > 0).any(0).nonzero()[0].item() for frame in source.frames]
    assert left == sorted(left) and len(left) == 9
    assert source.has_alpha and source.kind == "video"


def test_gaps_are_named(tmp_path):
    entries = {f"{i:03d}.png": disc() for i in (0, 1, 4, 5, 7)}
    with pytest.raises(BadInput, match=r"missing between 0 and 7: 2, 3, 6;"):
        read(save_zip(tmp_path / "a.zip", entries, tmp_path))


def test_the_first_frame_of_another_size_is_named(tmp_path):
    entries = {"0.png": disc(), "1.png": disc(), "2.png": disc(size=48), "3.png": disc(size=40)}
    with pytest.raises(BadInput, match=r"2\.png is 48 x 48 pixels, 0\.png is 64 x 64"):
        read(save_zip(tmp_path / "a.zip", entries, tmp_path))


@pytest.mark.parametrize(("count", "message"), [(0, "no frame"), (1, "only one frame")])
def test_a_folder_needs_two_frames(tmp_path, count, message):
    entries = {f"{i}.png": disc() for i in range(count)}
    with pytest.raises(BadInput, match=message):
        read(save_zip(tmp_path / "a.zip", entries, tmp_path))


def test_two_frames_with_one_number_are_refused(tmp_path):
    with pytest.raises(BadInput, match="same number"):
        read(save_zip(tmp_path / "a.zip", {"1.png": disc(), "01.png": disc(), "2.png": disc()}, tmp_path))


def test_a_broken_frame_is_named(tmp_path):
    save_zip(tmp_path / "a.zip", {"0.png": disc()}, tmp_path)
    with zipfile.ZipFile(tmp_path / "a.zip", "a") as archive:
        archive.writestr("1.png", b"no picture at all")
    with pytest.raises(BadInput, match=r"the frame 1\.png: the file is a text file"):
        read(tmp_path / "a.zip")


@pytest.mark.parametrize("scene", ["scene.usdc", "scene.USDA", "deep/scene.usd"])
def test_a_scene_is_no_folder_of_frames(tmp_path, scene):
    save_zip(tmp_path / "a.zip", {"0.png": disc(), "1.png": disc()}, tmp_path)
    with zipfile.ZipFile(tmp_path / "a.zip", "a") as archive:
        archive.writestr(scene, b"PXR-USDC")
    with pytest.raises(BadInput, match=rf"3D scene .*{scene}.*give pictures"):
        read(tmp_path / "a.zip")
    with pytest.raises(BadInput, match=rf"3D scene .*{scene}.*give pictures"):
        check_media(tmp_path / "a.zip")


# Bad input


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(BadInput, match="not a file"):
        read_source(tmp_path / "nothing", tmp_path, 8)


def test_a_folder_in_place_of_a_file_is_refused(tmp_path):
    with pytest.raises(BadInput, match="not a file"):
        read_source(tmp_path, tmp_path, 8)


def test_an_empty_file_is_refused(tmp_path):
    (tmp_path / "a.png").write_bytes(b"")
    with pytest.raises(BadInput, match="empty"):
        read(tmp_path / "a.png")


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("share", [0.02, 0.5, 0.9])
def test_a_truncated_picture_is_refused(tmp_path, suffix, share):
    noise = np.random.default_rng(0).integers(0, 255, (128, 128, 3), np.uint8)
    content = save(tmp_path / f"a{suffix}", noise).read_bytes()
    (tmp_path / f"a{suffix}").write_bytes(content[: int(share * len(content))])
    with pytest.raises(BadInput, match=r"cut off or broken|cannot be read"):
        read(tmp_path / f"a{suffix}")


def test_text_called_png_is_refused(tmp_path):
    (tmp_path / "a.png").write_text("once upon a time there was a newt")
    with pytest.raises(BadInput, match="text file"):
        read(tmp_path / "a.png")


def test_unknown_bytes_are_refused(tmp_path):
    (tmp_path / "a.png").write_bytes(bytes(range(256)) * 4)
    with pytest.raises(BadInput, match="not known"):
        read(tmp_path / "a.png")


@pytest.mark.parametrize(
    ("width", "height", "message"),
    [
        (1, 1, "at least 32"),
        (31, 31, "at least 32"),
        (20_000, 10, "crop it"),
        (10, 20_000, "crop it"),
        (11_000, 11_000, "million"),
    ],
)
def test_sizes_out_of_range_are_refused_before_decoding(tmp_path, width, height, message):
    with pytest.raises(BadInput, match=message) as refusal:
        read(png_header(tmp_path / "a.png", width, height))
    assert f"{width} x {height}" in str(refusal.value)


def test_a_heic_picture_is_refused_by_name(tmp_path):
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(64))
    with pytest.raises(BadInput, match="HEIC pictures cannot be read"):
        read(tmp_path / "a.heic")


def test_an_avif_keeps_color_and_alpha(tmp_path):
    image = pytest.importorskip("PIL.Image", reason="Pillow writes AVIF")
    image.fromarray(disc()).save(tmp_path / "a.avif", quality=100, subsampling="4:4:4")
    assert_shows_disc(read(tmp_path / "a.avif"), 0.03)
    image.fromarray(opaque(disc())).save(tmp_path / "a.avif", quality=100, subsampling="4:4:4")
    assert_shows_disc(read(tmp_path / "a.avif"), 0.03, has_alpha=False)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_the_orientation_of_an_avif_is_undone_as_that_of_a_jpeg(tmp_path, orientation):
    image = pytest.importorskip("PIL.Image", reason="Pillow writes AVIF")
    stored = np.zeros((40, 64, 3), np.uint8)
    stored[:20, :32], stored[:20, 32:], stored[20:, :32] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    exif = image.Exif()
    exif[274] = orientation
    image.fromarray(stored).save(tmp_path / "a.avif", quality=100, subsampling="4:4:4", exif=exif)
    jpeg = read(save(tmp_path / "a.jpg", stored, Orientation=orientation))
    avif = read(tmp_path / "a.avif")
    assert avif.frames.shape == jpeg.frames.shape
    assert (avif.frames - jpeg.frames).abs().mean() < 0.02  # JPEG blurs colors at edges; another turn gives 0.3


def test_avif_frames_of_a_folder_are_read(tmp_path):
    image = pytest.importorskip("PIL.Image", reason="Pillow writes AVIF")
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for i, frame in enumerate(walk(3)):
            image.fromarray(frame).save(tmp_path / "frame.avif")
            archive.write(tmp_path / "frame.avif", f"{i}.avif")
    source = read(tmp_path / "a.zip")
    assert source.has_alpha and len(source.frames) == 3


def test_an_avif_animation_is_refused_by_name(tmp_path):
    image = pytest.importorskip("PIL.Image", reason="Pillow writes AVIF")
    frames = [image.fromarray(frame) for frame in walk(3)]
    frames[0].save(tmp_path / "a.avif", save_all=True, append_images=frames[1:])
    with pytest.raises(BadInput, match="animated AVIF cannot be read here; export the animation as MP4, GIF or WebP"):
        read(tmp_path / "a.avif")


def test_a_video_of_one_frame_is_refused(tmp_path):
    with pytest.raises(BadInput, match="only one frame"):
        read(save_clip(tmp_path / "a.mp4", walk(1), "libx264", "yuv420p"))


def test_a_video_without_frames_is_refused(tmp_path):
    save_clip(tmp_path / "a.mkv", walk(3), "ffv1", "bgra")
    content = (tmp_path / "a.mkv").read_bytes()
    (tmp_path / "a.mkv").write_bytes(content[: content.index(b"\x1f\x43\xb6\x75")])  # up to the first cluster
    with pytest.raises(BadInput, match=r"no frame|cut off or broken"):
        read(tmp_path / "a.mkv")


@pytest.mark.parametrize("share", [0.1, 0.6, 0.95])
def test_an_mp4_without_its_end_is_refused(tmp_path, share):
    content = save_clip(tmp_path / "a.mp4", walk(8), "libx264", "yuv420p").read_bytes()
    (tmp_path / "a.mp4").write_bytes(content[: int(share * len(content))])
    with pytest.raises(BadInput, match="cut off or broken"):
        read(tmp_path / "a.mp4")


def test_an_mp4_of_zeros_is_refused(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(4000))
    with pytest.raises(BadInput):
        read(tmp_path / "a.mp4")


def test_a_video_that_changes_its_size_is_refused(tmp_path):
    small = [frame[:48, :48] for frame in walk(4)]
    first = save_clip(tmp_path / "a.ts", walk(4), "mpeg2video", "yuv420p", 25)
    second = save_clip(tmp_path / "b.ts", small, "mpeg2video", "yuv420p", 25)
    (tmp_path / "c.ts").write_bytes(first.read_bytes() + second.read_bytes())
    with pytest.raises(BadInput, match="changes its frame size"):
        read(tmp_path / "c.ts")


def test_sound_alone_is_refused(tmp_path):
    import av

    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("aac", 44100)
        silence = av.AudioFrame.from_ndarray(np.zeros((1, 4096), np.float32), format="fltp", layout="mono")
        silence.sample_rate = 44100
        container.mux(stream.encode(silence))
        container.mux(stream.encode(None))
    with pytest.raises(BadInput, match="only sound"):
        read(tmp_path / "a.mp4")


def test_a_broken_animated_webp_is_refused(tmp_path):
    content = save_clip(tmp_path / "a.webp", walk(5), "libwebp_anim", "bgra", lossless="1").read_bytes()
    (tmp_path / "a.webp").write_bytes(content[: int(0.6 * len(content))])
    with pytest.raises(BadInput, match="broken"):
        read(tmp_path / "a.webp")
