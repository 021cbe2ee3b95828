from pathlib import Path

import numpy as np
import pytest
import torch
from media_files import disc, opaque, save, save_clip, walk

from dg4d_lib.errors import BadInput
from dg4d_lib.settings import SubjectSettings
from dg4d_lib.video.framing import bounding_box
from steps.artifacts.media import read_frames, read_png
from steps.artifacts.pose import read_turn
from steps.prepare_subject import run
from steps.profiles import PREVIEW, step_settings
from steps.runtime.job import Job, StepReport


def prepare(source: Path, out: Path, **settings: object) -> StepReport:
    out.mkdir()
    names = {"subject": "subject.png", "footage": "footage.zip", "pose": "pose.json", "picture": "picture.png"}
    outputs = {port: out / name for port, name in names.items()}
    subject = PREVIEW.model_copy(update={"subject": SubjectSettings(size=64, **settings)})
    made = step_settings("prepare_subject", subject)
    return run(Job({"source": source}, outputs, made, 0, lambda *_: None, out))


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


def slanted_legs(frames: int = 8) -> np.ndarray:
    """A table on two thin legs, the right one longer: nearer to the camera."""
    film = np.zeros((frames, 64, 64, 4), np.uint8)
    film[:, 16:36, 10:54] = 255
    film[:, 36:50, 12:15] = film[:, 36:56, 49:52] = 255
    return film


def test_footage_on_a_slanted_ground_line_is_turned(tmp_path):
    source = save_clip(tmp_path / "a.mkv", slanted_legs(), "ffv1", "bgra")
    turns = []
    for name, factor in (("half", 0.5), ("none", 0.0)):
        facts = prepare(source, tmp_path / name, framing="keep", ground_turn=factor)
        turns.append(read_turn(tmp_path / name / "pose.json", 0.0))
        assert any("the right side is taken to be nearer" in note for note in facts.notes) == (factor > 0)
    assert 3 < turns[0] <= 25 and turns[1] == 0
    assert read_turn(tmp_path / "half" / "pose.json", -12.0) == -12


def test_a_broken_pose_is_refused(tmp_path):
    for text in ("{", '{"turn_deg": 80}', '{"turn_deg": null}', "[]"):
        (tmp_path / "pose.json").write_text(text)
        with pytest.raises(BadInput, match="no pose"):
            read_turn(tmp_path / "pose.json", 0.0)
    assert read_turn(None, 0.0) == 0 and read_turn(tmp_path / "pose.json", 5.0) == 5


def test_the_same_file_gives_the_same_bytes(tmp_path):
    source = save_clip(tmp_path / "a.mp4", walk(4), "libx264", "yuv420p")
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
