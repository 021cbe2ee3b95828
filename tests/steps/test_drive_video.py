from pathlib import Path

import pytest
import torch
from media_files import disc

from dg4d_lib.errors import BadInput
from dg4d_lib.settings import DrivingSettings
from dg4d_lib.video.driving import DrivingVideo
from steps.drive_video import run
from steps.job import Facts, Job
from steps.media import read_frames, read_png, write_frames, write_png
from steps.profiles import DriveVideoSettings


def drive(folder: Path, inputs: dict[str, Path], **driving: object) -> Facts:
    settings = DriveVideoSettings(driving=DrivingSettings(**driving))
    return run(Job(inputs, {"driving_video": folder / "driving.zip"}, settings, 0, lambda *_: None, folder))


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
    assert (tmp_path / "driving.zip").read_bytes() == footage.read_bytes()


@pytest.mark.parametrize(("count", "size", "message"), [(1, 64, "at least two"), (3, 32, "32 x 32 .* 64 x 64")])
def test_footage_that_does_not_fit_is_refused(tmp_path, subject, count, size, message):
    with pytest.raises(BadInput, match=message):
        drive(tmp_path, {"subject": subject, "footage": footage_of(tmp_path / "footage.zip", count, size)})


def test_without_footage_the_subject_moves(tmp_path, subject):
    facts = drive(tmp_path, {"subject": subject}, motion="bend", frames=5, fps=6.0)
    video = read_frames(tmp_path / "driving.zip", tmp_path)
    assert len(video) == 5 and video.fps == 6
    assert any("bend" in note for note in facts.notes)
    assert (video.coverage[1:3] - video.coverage[0]).abs().max() > 0.2
    still = torch.minimum(video.coverage[0], read_png(subject)[..., 3:]).sum()
    assert still / torch.maximum(video.coverage[0], read_png(subject)[..., 3:]).sum() > 0.95
