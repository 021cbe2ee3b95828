import json
import os
import shutil
import stat
from pathlib import Path

import pytest

from flows import home
from flows.engine.events import StepEvent, listening
from flows.engine.remarks import CAPTIONS, MOST_PICTURES, REMARKED, remark
from flows.packages.view import viewer_of_splats
from steps.contract import ProvenanceRecord, StepResult, digest_of

NOTE = "The background was guessed."


@pytest.fixture(autouse=True)
def _home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "home"))


def result(picture: bytes, *notes: str, step: str = REMARKED) -> StepResult:
    ref = home.store().put_bytes(picture, "image/png")
    record = ProvenanceRecord(
        step=step, code_version="1", request_digest=digest_of(step), inputs={}, outputs={"picture": ref.digest},
        settings={}, seed=0, backend="cpu", notes=notes, duration_s=0, peak_memory_mb=0,
    )  # fmt: skip
    return StepResult(outputs={"picture": ref}, provenance=record)


def told(item: str, done: StepResult) -> list[str]:
    events: list[StepEvent] = []
    with listening(events.append):
        remark(item, done.provenance.step, done)
    return [event.text for event in events if event.kind == "remark"]


def shown(item: str, picture: bytes) -> Path:
    (text,) = told(item, result(picture, NOTE))
    before = f"{NOTE} Source, matte and cut-out: "
    assert text.startswith(before)
    return Path(text.removeprefix(before))


def test_the_picture_of_a_guess_is_for_its_owner_alone() -> None:
    before = os.umask(0)
    try:
        path = shown("a fox/red", b"picture")
    finally:
        os.umask(before)
    assert path.name.startswith("a-fox-red-") and path.read_bytes() == b"picture"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
    assert list(path.parent.iterdir()) == [path]


def test_only_the_newest_pictures_are_kept_and_one_that_is_shown_again_is_new() -> None:
    first = shown("first", b"first")
    others = [first.with_name(f"{i:03d}.png") for i in range(MOST_PICTURES)]
    for i, path in enumerate([first, *others]):
        path.touch()
        os.utime(path, (1000 + i, 1000 + i))
    assert shown("first", b"first") == first
    assert set(first.parent.iterdir()) == {first, *others[1:]}


def test_the_first_look_at_the_splats_is_a_page_for_its_owner() -> None:
    done = result(b"picture", NOTE, step="fit_gaussians")
    ref = home.store().put_bytes(b"D4WS of a fox", "application/vnd.dg4d.splats+websplats")
    (text,) = told("a fox/red", done.model_copy(update={"outputs": {**done.outputs, "first_look": ref}}))
    page = Path(text.removeprefix("Preview of the static splats: "))
    assert page.parent == home.first_looks() and page.name.startswith("a-fox-red-") and page.suffix == ".html"
    assert stat.S_IMODE(page.stat().st_mode) == 0o600
    assert page.read_text() == viewer_of_splats(b"D4WS of a fox", "a fox/red")
    assert not home.cutouts().exists()


def test_other_steps_say_nothing() -> None:
    assert told("fox", result(b"picture", NOTE, step="fit_motion")) == []
    assert not home.cutouts().exists()


def test_the_picture_of_every_cutout_is_shown() -> None:
    (text,) = told("fox", result(b"picture"))
    path = Path(text.removeprefix("Source, matte and cut-out: "))
    assert path.read_bytes() == b"picture"


def test_failed_gates_of_a_cutout_are_told_with_their_advice() -> None:
    gate = {"value": 0.4, "least": None, "most": 0.1, "unit": "", "advice": "give a mask"}
    rows = [{"name": "cut-out pieces", "passed": False, **gate}, {"name": "cut-out holes", "passed": True, **gate}]
    done = result(b"picture", NOTE)
    ref = home.store().put_bytes(json.dumps({"gates": rows}).encode(), "application/vnd.dg4d.gates+json")
    (text,) = told("fox", done.model_copy(update={"outputs": {**done.outputs, "cutout_gates": ref}}))
    assert f"{NOTE} Not accepted: cut-out pieces = 0.4, allowed: at most 0.1; give a mask. Source" in text
    assert "holes" not in text


def test_a_picture_that_is_gone_leaves_the_note_and_no_empty_file() -> None:
    done = result(b"picture", NOTE)
    shutil.rmtree(home.home() / "store")
    assert told("fox", done) == [NOTE]
    assert list(home.cutouts().iterdir()) == []


def test_views_that_contradict_each_other_are_told_with_their_picture() -> None:
    (text,) = told("fox", result(b"views", NOTE, step="prepare_views"))
    assert text.startswith(f"{NOTE} {CAPTIONS['prepare_views']}: ")
