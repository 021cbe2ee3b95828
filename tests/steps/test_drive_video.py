import json
import zipfile
from pathlib import Path

import pytest
import torch
from media_files import disc
from tiny_svd import save_tiny_svd

from dg4d_lib.errors import BadInput
from dg4d_lib.input_settings import SvdSettings, WarpSettings
from dg4d_lib.video.driving import DrivingVideo
from steps.artifacts.media import read_frames, read_png, write_frames, write_png
from steps.drive_video import run
from steps.profiles import PREVIEW, step_settings
from steps.runtime.job import Job, StepReport

PORTS = {"driving_video": "zip", "picture": "png", "candidates": "png", "ranking": "json", "films": "zip"}


def drive(
    folder: Path, inputs: dict[str, Path], seed: int = 0, kind: type = WarpSettings, **driving: object
) -> StepReport:
    settings = step_settings("drive_video", PREVIEW.model_copy(update={"driving": kind(**driving)}))
    outputs = {name: folder / f"{name}.{suffix}" for name, suffix in PORTS.items()}
    return run(Job(inputs, outputs, settings, seed, lambda *_: None, folder))


@pytest.fixture
def subject(tmp_path: Path) -> Path:
    write_png(tmp_path / "subject.png", torch.from_numpy(disc()) / 255)
    return tmp_path / "subject.png"


def footage_of(path: Path, count: int, size: int) -> Path:
    frames = torch.rand(count, size, size, 4, generator=torch.Generator().manual_seed(0))
    write_frames(path, DrivingVideo(frames[..., :3], frames[..., 3:], 5.0))
    return path


def test_footage_goes_through_untouched(tmp_path, subject):
    footage = footage_of(tmp_path / "footage.zip", 3, 64)
    drive(tmp_path, {"subject": subject, "footage": footage})
    assert (tmp_path / "driving_video.zip").read_bytes() == footage.read_bytes()
    height, width = read_png(tmp_path / "picture.png").shape[:2]
    assert width > 3 * 160 > 2 * height  # three frames in a row


@pytest.mark.parametrize(("count", "size", "message"), [(1, 64, "at least two"), (3, 32, "32 x 32 .* 64 x 64")])
def test_footage_that_does_not_fit_is_refused(tmp_path, subject, count, size, message):
    with pytest.raises(BadInput, match=message):
        drive(tmp_path, {"subject": subject, "footage": footage_of(tmp_path / "footage.zip", count, size)})


def test_without_footage_the_subject_moves(tmp_path, subject):
    facts = drive(tmp_path, {"subject": subject}, motion="bend", frames=5, fps=6.0)
    video = read_frames(tmp_path / "driving_video.zip", tmp_path)
    assert len(video) == 5 and video.fps == 6
    assert any("bend" in note for note in facts.notes)
    assert (video.alpha[1:3] - video.alpha[0]).abs().max() > 0.2
    still = torch.minimum(video.alpha[0], read_png(subject)[..., 3:]).sum()
    assert still / torch.maximum(video.alpha[0], read_png(subject)[..., 3:]).sum() > 0.95


def test_footage_that_shows_nothing_of_the_subject_is_warned_of(tmp_path, subject):
    facts = drive(tmp_path, {"subject": subject, "footage": footage_of(tmp_path / "footage.zip", 4, 64)})
    assert "hard to follow" in facts.notes[0]
    still = read_png(subject)
    shifted = torch.stack([still.roll(shift, 1) for shift in (0, 2, 4, 5, 4, 2)])
    write_frames(tmp_path / "fine.zip", DrivingVideo(shifted[..., :3], shifted[..., 3:], 5.0))
    assert not drive(tmp_path, {"subject": subject, "footage": tmp_path / "fine.zip"}).notes


def test_the_best_of_several_motions_is_taken_and_all_are_shown(tmp_path, subject):
    facts = drive(tmp_path, {"subject": subject}, candidates=3, frames=6)
    ranking = json.loads((tmp_path / "ranking.json").read_text())
    rows = ranking["candidates"]
    assert sorted(row["number"] for row in rows) == [1, 2, 3]
    assert [row["total"] for row in rows] == sorted((row["total"] for row in rows), reverse=True)
    assert ranking["taken"] == rows[0]["number"]
    assert rows[0]["name"] in facts.notes[0] and "best of 3" in facts.notes[1]
    sheet = read_png(tmp_path / "candidates.png")
    assert sheet.shape[0] > 3 * 160 and sheet.shape[1] > 6 * 160
    with zipfile.ZipFile(tmp_path / "films.zip") as films:
        assert films.namelist() == ["1.mp4", "2.mp4", "3.mp4"]
    best = (tmp_path / "driving_video.zip").read_bytes()
    drive(tmp_path, {"subject": subject}, pick=ranking["taken"], frames=6)
    assert (tmp_path / "driving_video.zip").read_bytes() == best


def test_a_pick_makes_that_motion_and_no_other(tmp_path, subject):
    facts = drive(tmp_path, {"subject": subject}, pick=3, candidates=5, motion="sway", frames=4)
    assert "breathe" in facts.notes[0]
    assert not (tmp_path / "ranking.json").exists()


@pytest.mark.usefixtures("quick_segmentation")
def test_video_diffusion_runs_from_a_folder_and_its_weights_are_in_the_record(tmp_path, subject):
    folder = save_tiny_svd(tmp_path / "svd")
    knobs = {"frames": 3, "height": 64, "width": 64, "model": {"weights": str(folder), "num_inference_steps": 2}}
    facts = drive(tmp_path, {"subject": subject}, kind=SvdSettings, candidates=2, **knobs)
    ranking = json.loads((tmp_path / "ranking.json").read_text())
    assert {row["name"] for row in ranking["candidates"]} == {"seed 0", "seed 1"}
    assert len(read_frames(tmp_path / "driving_video.zip", tmp_path)) == 3
    assert facts.backend == "cpu (diffusers)"
    assert any("unet" in name for name in facts.weights) and any("vae" in name for name in facts.weights)
    assert "Stable Video Diffusion" in facts.notes[0] and facts.licenses
    drive(tmp_path, {"subject": subject}, kind=SvdSettings, pick=2, **knobs)
    second = (tmp_path / "driving_video.zip").read_bytes()
    drive(tmp_path, {"subject": subject}, kind=SvdSettings, seed=1, pick=1, **knobs)
    assert (tmp_path / "driving_video.zip").read_bytes() == second
