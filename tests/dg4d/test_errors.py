"""Errors of the API are the documented ones, also where a step finds the fault."""

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import dg4d
from flows.step_errors import StepBadInput, StepCrashed, StepLost, StepMissing, StepUnreachable


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The real steps in this process, under a home of their own."""
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("DG4D_EXECUTOR", "in_process")
    monkeypatch.chdir(tmp_path)


def png(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "PNG")
    return file.getvalue()


NOISE = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
UNUSABLE = {
    "cut off": png(NOISE)[:2000],
    "blank": png(np.full((64, 64, 3), 255, np.uint8)),
    "transparent": png(np.zeros((64, 64, 4), np.uint8)),
    "tiny": png(NOISE[:2, :2]),
    "text": b"not a picture",
}


@pytest.mark.parametrize("kind", UNUSABLE)
def test_an_unusable_picture_is_bad_input(kind: str) -> None:
    Path("picture.png").write_bytes(UNUSABLE[kind])
    with pytest.raises(dg4d.BadInput):
        dg4d.make("picture.png")
    failed = dg4d.batch(["picture.png"]).errors["picture"]
    assert isinstance(failed, dg4d.BadInput)


def test_errors_of_steps_are_the_errors_of_the_api() -> None:
    assert issubclass(dg4d.StepError, dg4d.DG4DError)
    assert issubclass(StepBadInput, dg4d.BadInput)
    assert all(issubclass(kind, dg4d.BackendUnavailable) for kind in (StepMissing, StepLost, StepUnreachable))
    assert not issubclass(StepCrashed, dg4d.BadInput | dg4d.BackendUnavailable)
