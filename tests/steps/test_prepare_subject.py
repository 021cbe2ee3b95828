import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from media_files import disc, opaque, save, save_clip, walk
from tiny_onnx import write_network

from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.inflation.hints import LAYER
from dg4d_lib.input_settings import SubjectSettings
from dg4d_lib.video import u2netp
from dg4d_lib.video.framing import bounding_box
from steps.artifacts.depth_fields import read_depth_field
from steps.artifacts.gates import read_rows
from steps.artifacts.media import read_frames, read_png
from steps.artifacts.pose import read_turn
from steps.prepare_subject import run
from steps.profiles import PREVIEW, step_settings
from steps.runtime.job import Job, StepReport


def prepare(
    source: Path,
    out: Path,
    mask: Path | None = None,
    depth: Path | None = None,
    layers: Path | None = None,
    **settings: object,
) -> StepReport:
    out.mkdir()
    names = ("depth_field.safetensors", "subject.png", "footage.zip", "pose.json", "cutout_gates.json", "picture.png")
    outputs = {name.partition(".")[0]: out / name for name in names}
    given = {"source": source, "mask": mask, "depth": depth, "layers": layers}
    inputs = {port: path for port, path in given.items() if path}
    subject = PREVIEW.model_copy(update={"subject": SubjectSettings(size=64, **settings)})
    made = step_settings("prepare_subject", subject)
    return run(Job(inputs, outputs, made, 0, lambda *_: None, out))


def test_a_picture_becomes_a_square_cutout_and_no_footage(tmp_path):
    prepare(save(tmp_path / "a.png", opaque(disc())), tmp_path / "out")
    subject = read_png(tmp_path / "out" / "subject.png")
    left, top, right, bottom = bounding_box(subject[None, ..., 3])
    assert subject.shape == (64, 64, 4)
    assert (right - left, bottom - top) == (pytest.approx(51, abs=3), pytest.approx(51, abs=3))
    assert not (tmp_path / "out" / "footage.zip").exists() and not (tmp_path / "out" / "pose.json").exists()


def test_the_source_its_matte_and_the_cutout_are_shown_side_by_side(tmp_path):
    prepare(save(tmp_path / "a.png", opaque(disc())[:, 8:-8]), tmp_path / "out")
    source, matte, cutout = read_png(tmp_path / "out" / "picture.png").split(256, 1)
    subject = read_png(tmp_path / "out" / "subject.png")[..., 3]
    assert source.shape == matte.shape == cutout.shape == (256, 256, 3)
    assert float(matte.mean()) == pytest.approx(float(subject.mean()), abs=0.01)
    assert matte[128, 128].min() == 1 and matte[0, 0].max() == 0
    assert cutout[0, 0].min() == 1
    assert torch.allclose(source[128, 128], cutout[128, 128], atol=0.02)


def test_a_video_becomes_footage_whose_first_frame_is_the_subject(tmp_path):
    facts = prepare(save_clip(tmp_path / "a.mkv", walk(9), "ffv1", "bgra"), tmp_path / "out", max_frames=5)
    footage = read_frames(tmp_path / "out" / "footage.zip", tmp_path)
    subject = read_png(tmp_path / "out" / "subject.png")
    assert len(footage) == 5 and footage.fps == pytest.approx(5)
    assert torch.equal(torch.cat([footage.frames[0], footage.alpha[0]], -1), subject)
    assert any("5 of the video's 9 frames" in note for note in facts.notes)


def table(right_leg: int, frames: int = 8) -> np.ndarray:
    """A table on two thin legs; a longer one is nearer to the camera."""
    film = np.zeros((frames, 64, 64, 4), np.uint8)
    film[:, 16:36, 10:54] = 255
    film[:, 36:50, 12:15] = film[:, 36 : 36 + right_leg, 49:52] = 255
    return film


@pytest.mark.parametrize(
    ("right_leg", "ground_turn", "least", "most", "noted"),
    [
        (20, 0.5, 3, 25, ", right end nearer; "),
        (14, 0.5, 0, 0, ": 0 degrees"),
        (20, 0.0, None, None, ""),
        (14, 0.0, None, None, ""),
    ],
)
def test_footage_is_turned_as_its_ground_line(right_leg, ground_turn, least, most, noted, tmp_path):
    source = save_clip(tmp_path / "a.mkv", table(right_leg), "ffv1", "bgra")
    facts = prepare(source, tmp_path / "out", framing="keep", ground_turn=ground_turn)
    found = read_turn(tmp_path / "out" / "pose.json")
    assert found is None if least is None else least <= found <= most
    assert [noted in note for note in facts.notes if "estimated yaw" in note] == [True] * bool(noted)


def test_a_broken_pose_is_refused(tmp_path):
    for text in ("{", '{"turn_deg": 80}', "{}", "[]"):
        (tmp_path / "pose.json").write_text(text)
        with pytest.raises(BadInput, match="not a pose"):
            read_turn(tmp_path / "pose.json")
    assert read_turn(None) is None


def test_the_same_file_gives_the_same_bytes(tmp_path):
    source = save_clip(tmp_path / "a.mp4", walk(2), "libx264", "yuv420p")
    for name in ("one", "two"):
        prepare(source, tmp_path / name)
    for name in ("subject.png", "footage.zip", "picture.png"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


def test_the_settings_are_read(tmp_path):
    source = save(tmp_path / "a.png", disc())
    prepare(source, tmp_path / "wide", framing="center", border=0.5)
    prepare(source, tmp_path / "kept", framing="keep")
    wide, kept = (read_png(tmp_path / name / "subject.png") for name in ("wide", "kept"))
    left, _, right, _ = bounding_box(wide[None, ..., 3])
    assert right - left == pytest.approx(32, abs=2)
    assert bounding_box(kept[None, ..., 3])[0] == 13


def test_nothing_is_written_for_a_picture_that_is_refused(tmp_path):
    blank = save(tmp_path / "a.png", opaque(disc()) * 0 + 128)
    with pytest.raises(BadInput, match="no subject found"):
        prepare(blank, tmp_path / "out")
    assert not list((tmp_path / "out").iterdir())


def test_a_fully_transparent_file_is_refused(tmp_path):
    with pytest.raises(BadInput, match="fully transparent"):
        prepare(save(tmp_path / "a.png", disc() * 0), tmp_path / "out")


def slanted(size: int = 64) -> np.ndarray:
    """Distances of a wall whose right side is nearer, in meters."""
    return np.repeat(np.linspace(3.0, 2.0, size, dtype=np.float32)[None], size, 0)[..., None]


def rise(path: Path) -> float:
    """Return by how much the right side of a field is nearer than the left one, world units."""
    field = read_depth_field(path)
    left, right = (field.middle[:, part][field.known[:, part]].mean() for part in (slice(0, 32), slice(32, 64)))
    return float(right - left)


def test_distances_and_inverse_depths_become_a_field_in_the_frame_of_the_subject(tmp_path):
    source = save(tmp_path / "a.png", disc(left=20))
    far = slanted()
    far[:8] = np.inf  # a sky
    near = (65535 * (1 / slanted() - 1 / 3) / (1 / 2 - 1 / 3)).astype(np.uint16)
    files = {
        "exr": save(tmp_path / "d.exr", far, "float"),
        "tif": save(tmp_path / "d.tif", 1000 * slanted(), "float"),
        "png": save(tmp_path / "d.png", near, "uint16"),
    }
    rises = {}
    for name, depth in files.items():
        facts = prepare(source, tmp_path / name, depth=depth)
        rises[name] = rise(tmp_path / name / "depth_field.safetensors")
        said = "relative inverse depth" if name == "png" else "distances"
        assert any(said in note for note in facts.notes)
        assert read_png(tmp_path / name / "picture.png").shape == (256, 4 * 256, 3)
    assert rises["exr"] == pytest.approx(rises["tif"], abs=0.02)
    assert min(rises.values()) > 0.1
    flipped = prepare(source, tmp_path / "read", depth=files["tif"], depth_kind="inverse")
    assert rise(tmp_path / "read" / "depth_field.safetensors") < -0.1 and flipped.notes


def test_the_depth_of_an_opaque_picture_is_cropped_as_the_picture_is(tmp_path):
    picture = np.full((96, 160, 4), 255, np.uint8)
    picture[16:80, 90:154] = disc()
    source = save(tmp_path / "a.png", opaque(picture))
    depth = np.full((96, 160, 1), 9.0, np.float32)
    depth[16:80, 90:154] = slanted()
    prepare(source, tmp_path / "out", depth=save(tmp_path / "d.exr", depth, "float"), matting="backdrop")
    field = read_depth_field(tmp_path / "out" / "depth_field.safetensors")
    alpha = read_png(tmp_path / "out" / "subject.png")[..., 3]
    assert float((field.known & (alpha > 0.5)).sum() / (alpha > 0.5).sum()) > 0.8
    assert rise(tmp_path / "out" / "depth_field.safetensors") > 0.1


def test_layers_become_offsets_and_serve_the_first_frame_of_a_video(tmp_path):
    source = save_clip(tmp_path / "a.mkv", walk(3), "ffv1", "bgra")
    levels = np.full((64, 64, 1), 128, np.uint8)
    levels[:, 30:] = 255
    facts = prepare(source, tmp_path / "out", layers=save(tmp_path / "l.png", levels), framing="keep")
    field = read_depth_field(tmp_path / "out" / "depth_field.safetensors")
    assert field.sigma == 0 and any("layers" in note for note in facts.notes)
    assert float(field.middle.max()) == pytest.approx(LAYER, abs=0.01)
    assert abs(float(field.middle[32, 20])) < 0.01


NAN = np.full((64, 64, 1), np.nan, np.float32)


@pytest.mark.parametrize(
    ("name", "pixels", "form", "reason"),
    [
        (
            "d.png",
            np.repeat(np.arange(50, dtype=np.uint8)[None], 50, 0)[..., None],
            "uint8",
            "50 x 50 .*picture 64 x 64",
        ),
        ("d.png", np.full((64, 64, 1), 90, np.uint8), "uint8", "one value"),
        ("d.exr", NAN, "float", "values for 0%"),
        ("d.png", disc()[..., :3], "uint8", "colored"),
        ("d.tif", -slanted(), "float", "values for 0%"),
    ],
)
def test_pictures_that_are_no_depth_are_refused(tmp_path, name, pixels, form, reason):
    source = save(tmp_path / "a.png", disc())
    with pytest.raises(BadInput, match=reason):
        prepare(source, tmp_path / "out", depth=save(tmp_path / name, pixels, form))


def sparse(share: float, size: int = 256) -> np.ndarray:
    """Distances of a wall, known for a share of its pixels at random."""
    known = np.random.default_rng(0).random((size, size, 1)) < share
    return np.where(known, slanted(size), np.nan).astype(np.float32)


def test_sparse_depth_is_used_and_its_share_is_reported(tmp_path):
    source = save(tmp_path / "a.png", np.kron(disc(left=20), np.ones((4, 4, 1), np.uint8)))
    facts = prepare(source, tmp_path / "out", depth=save(tmp_path / "d.exr", sparse(0.4), "float"))
    (note,) = (note for note in facts.notes if note.startswith("depth:"))
    assert int(re.findall(r"known for (\d+)% of the subject", note)[0]) == pytest.approx(40, abs=5)
    field = read_depth_field(tmp_path / "out" / "depth_field.safetensors")
    alpha = read_png(tmp_path / "out" / "subject.png")[..., 3]
    assert float((field.known & (alpha > 0.5)).sum() / (alpha > 0.5).sum()) > 0.8
    dense = prepare(source, tmp_path / "dense", depth=save(tmp_path / "d.exr", slanted(256), "float"))
    assert not any("known for" in note for note in dense.notes)
    rises = [rise(tmp_path / name / "depth_field.safetensors") for name in ("out", "dense")]
    assert rises[0] == pytest.approx(rises[1], abs=0.01)


def test_too_sparse_depth_is_refused_with_its_share(tmp_path):
    source = save(tmp_path / "a.png", np.kron(disc(left=20), np.ones((4, 4, 1), np.uint8)))
    with pytest.raises(BadInput, match=r"values for (1[5-9]|2[0-4])% of the subject"):
        prepare(source, tmp_path / "out", depth=save(tmp_path / "d.exr", sparse(0.2), "float"))


def test_videos_and_zips_are_no_depth(tmp_path):
    source = save(tmp_path / "a.png", disc())
    frames = zipped(tmp_path / "d.zip", [disc(), disc()])
    clip = save_clip(tmp_path / "d.mkv", walk(3), "ffv1", "bgra")
    for number, (given, reason) in enumerate(((frames, "is a zip"), (clip, "is a video"))):
        for port in ("depth", "layers"):
            with pytest.raises(BadInput, match=reason):
                prepare(source, tmp_path / f"{port}{number}", **{port: given})


def half_mask(height: int, width: int, left: int = 0) -> np.ndarray:
    """White in a band of 32 columns."""
    mask = np.zeros((height, width, 3), np.uint8)
    mask[8:-8, left : left + 32] = 255
    return mask


def zipped(path: Path, pictures: list[np.ndarray]) -> Path:
    """Pictures as a zip of numbered frames."""
    with zipfile.ZipFile(path, "w") as archive:
        for number, picture in enumerate(pictures):
            frame = save(path.with_name(f"{number:03d}.png"), picture)
            archive.write(frame, frame.name)
    return path


def test_a_mask_replaces_matting_and_is_not_judged(tmp_path):
    picture = opaque(disc())
    mask = save(tmp_path / "mask.png", half_mask(*picture.shape[:2], left=picture.shape[1] // 2))
    facts = prepare(save(tmp_path / "a.png", picture), tmp_path / "out", mask, framing="keep")
    alpha = read_png(tmp_path / "out" / "subject.png")[..., 3]
    assert alpha[:, :24].max() == 0 and alpha[24:40, 40:48].min() == 1
    assert facts.weights == {} and not (tmp_path / "out" / "cutout_gates.json").exists()


def test_the_alpha_channel_of_a_mask_is_the_mask(tmp_path):
    picture = opaque(disc())
    mask = np.dstack([np.zeros_like(picture[..., :3]), half_mask(*picture.shape[:2])[..., 0]])
    prepare(save(tmp_path / "a.png", picture), tmp_path / "out", save(tmp_path / "m.png", mask), framing="keep")
    assert read_png(tmp_path / "out" / "subject.png")[..., 3].max() == 1


def test_a_video_takes_a_mask_for_every_frame(tmp_path):
    film = [frame[..., :3] for frame in walk(4)]
    masks = [half_mask(*film[0].shape[:2], left=4 * i) for i in range(len(film))]
    source = zipped(tmp_path / "film.zip", film)
    prepare(source, tmp_path / "out", zipped(tmp_path / "masks.zip", masks), framing="keep")
    alpha = read_frames(tmp_path / "out" / "footage.zip", tmp_path).alpha[..., 0]
    firsts = [int((frame.amax(0) > 0.5).nonzero()[0]) for frame in alpha]
    assert firsts == sorted(set(firsts))


@pytest.mark.parametrize(
    ("mask", "says"),
    [
        (lambda height, width: half_mask(height, width + 8), r"--mask is \d+ x \d+ pixels, the picture \d+ x \d+"),
        (lambda height, width: np.zeros((height, width, 3), np.uint8), "the mask is empty"),
        (lambda height, width: half_mask(height, width) // 255, "largest value is 1 of 255, .* multiply .* by 255"),
        (lambda height, width: half_mask(height, width) * np.uint8([1, 0, 0]), "--mask is colored"),
    ],
    ids=["size", "empty", "labels", "colored"],
)
def test_a_mask_that_does_not_fit_is_refused(tmp_path, mask, says):
    picture = opaque(disc())
    with pytest.raises(BadInput, match=says):
        prepare(save(tmp_path / "a.png", picture), tmp_path / "out", save(tmp_path / "m.png", mask(*picture.shape[:2])))


def test_a_mask_of_off_white_is_read(tmp_path):
    picture = opaque(disc())
    mask = half_mask(*picture.shape[:2]) - np.uint8([0, 5, 15]) * (half_mask(64, 64) > 0)
    prepare(save(tmp_path / "a.png", picture), tmp_path / "out", save(tmp_path / "m.png", mask))


def test_a_box_of_one_pixel_is_refused_without_a_warning(tmp_path):
    with pytest.raises(BadInput, match=r"no subject found|at least \d+ pixels"):
        prepare(save(tmp_path / "a.png", opaque(disc())), tmp_path / "out", box=(30, 30, 1, 1))


def test_colored_masks_of_a_video_are_refused(tmp_path):
    film = [frame[..., :3] for frame in walk(2)]
    masks = zipped(tmp_path / "masks.zip", [half_mask(*film[0].shape[:2]) * np.uint8([0, 1, 0])] * 2)
    with pytest.raises(BadInput, match="--mask is colored"):
        prepare(zipped(tmp_path / "film.zip", film), tmp_path / "out", masks)


def test_an_almost_transparent_mask_is_named_so(tmp_path):
    picture = opaque(disc())
    mask = np.dstack([picture[..., :3], half_mask(*picture.shape[:2])[..., 0] // 255])
    with pytest.raises(BadInput, match=r"--mask is almost transparent.* must be opaque"):
        prepare(save(tmp_path / "a.png", picture), tmp_path / "out", save(tmp_path / "m.png", mask))


def test_one_mask_for_a_video_is_refused(tmp_path):
    film = [frame[..., :3] for frame in walk(4)]
    mask = save(tmp_path / "m.png", half_mask(*film[0].shape[:2]))
    says = "--mask has 1 frame, the video 4; give a folder with one mask for every frame"
    with pytest.raises(BadInput, match=says):
        prepare(zipped(tmp_path / "film.zip", film), tmp_path / "out", mask)


def test_several_masks_for_a_picture_are_refused(tmp_path):
    picture = opaque(disc())
    masks = zipped(tmp_path / "masks.zip", [half_mask(*picture.shape[:2])] * 6)
    with pytest.raises(BadInput, match="--mask has 6 frames, and the input is one picture; give one picture as"):
        prepare(save(tmp_path / "a.png", picture), tmp_path / "out", masks)


def two_squares() -> np.ndarray:
    """Two dark squares on white; "h w 3"."""
    picture = np.full((96, 96, 3), 255, np.uint8)
    picture[10:40, 8:38] = (200, 30, 30)
    picture[50:86, 52:88] = (30, 30, 200)
    return picture


def test_only_what_is_in_the_box_is_the_subject(tmp_path):
    source = save(tmp_path / "a.png", two_squares())
    prepare(source, tmp_path / "out", matting="backdrop", box=(46, 44, 48, 48))
    subject = read_png(tmp_path / "out" / "subject.png")
    visible = subject[subject[..., 3] > 0.5]
    assert (visible[:, 2] > visible[:, 0]).all()


def test_a_box_counts_pixels_of_the_file_and_not_of_the_shrunk_picture(tmp_path):
    large = two_squares().repeat(32, 0).repeat(32, 1)  # 3072 pixels a side, shrunk on reading
    source = save(tmp_path / "a.png", large)
    prepare(source, tmp_path / "out", matting="none", box=(52 * 32, 50 * 32, 36 * 32, 36 * 32), framing="keep")
    alpha = read_png(tmp_path / "out" / "subject.png")[..., 3]
    rows = (alpha.amax(1) > 0.5).nonzero().flatten()
    assert int(rows[0]) == pytest.approx(50 * 64 / 96, abs=1) and int(rows[-1]) + 1 == pytest.approx(
        86 * 64 / 96, abs=1
    )


def test_a_box_outside_of_the_picture_is_refused(tmp_path):
    with pytest.raises(BadInput, match=r"the box 60,0,50,20 reaches to x = 110 .* 96 x 96 pixels; give"):
        prepare(save(tmp_path / "a.png", two_squares()), tmp_path / "out", box=(60, 0, 50, 20))


@pytest.mark.parametrize("box", [(1, 2, 3), (0, 0, 0, 5), (-1, 0, 5, 5)])
def test_a_box_that_is_none_is_refused(box):
    with pytest.raises(ValueError, match="box"):
        SubjectSettings(box=box)


def test_a_network_of_the_weights_folder_cuts_out_and_is_recorded(tmp_path):
    """A model that says how red a pixel is."""
    folder = write_network(tmp_path / "red", mean=0.5, weights=(40.0, -40.0, 0.0), bias=-10.0)
    source = save(tmp_path / "a.png", two_squares())
    facts = prepare(source, tmp_path / "out", matting=str(folder), framing="keep")
    alpha = read_png(tmp_path / "out" / "subject.png")[..., 3]
    assert alpha[10:24, 8:22].mean() > 0.95 and alpha[34:, 34:].max() == 0
    assert any(name.endswith("onnx/model.onnx") for name in facts.weights)
    assert facts.licenses and any("segmentation network" in note for note in facts.notes)


def test_a_network_that_is_not_installed_names_the_command(tmp_path, monkeypatch):
    monkeypatch.setenv("DG4D_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    with pytest.raises(BackendUnavailable, match="dg4d weights pull birefnet"):
        prepare(save(tmp_path / "a.png", two_squares()), tmp_path / "out", matting="birefnet")


def test_an_estimated_cutout_is_judged_and_its_network_recorded(tmp_path):
    facts = prepare(save(tmp_path / "a.png", opaque(disc())), tmp_path / "out")
    rows = {row["name"]: row for row in read_rows(tmp_path / "out" / "cutout_gates.json")}
    assert list(rows) == ["cut-out pieces", "cut-out holes", "cut-out border", "cut-out agreement"]
    assert rows["cut-out pieces"]["value"] == 0
    assert facts.weights == u2netp.digests() and "Apache-2.0" in facts.licenses["u2netp"]


def test_none_keeps_the_picture_as_it_is(tmp_path):
    prepare(save(tmp_path / "a.png", opaque(disc())), tmp_path / "out", matting="none", framing="keep")
    assert read_png(tmp_path / "out" / "subject.png")[..., 3].min() == 1
