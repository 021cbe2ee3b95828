"""Conversions without a server: the same packages, records and faults as through Prefect."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from conversions import EVERY_STEP, RUN_FACTS, job, ran, store_is_sound, tree
from fake_steps import picture
from prefect.results import ResultRecord

from flows import home
from flows.convert import convert_job
from flows.engine import resources
from flows.engine.events import StepEvent, listening
from flows.engine.records import read_record, write_record
from flows.engine.versions import versions
from flows.inline import convert_inline
from flows.inputs.conversion_job import ConversionRequest
from flows.step_calls import Subject
from flows.step_errors import StepBadInput, StepCrashed
from steps.profiles import PREVIEW
from steps.store.artifact_store import StoreUnreachable


@pytest.fixture
def alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Fake steps in this process under a home of their own, and no server; the log of the steps."""
    for name, value in {
        "DG4D_HOME": tmp_path / "home",
        "DG4D_CATALOG": "fake_steps:STEPS",
        "DG4D_CODE_VERSION": "test",
        "DG4D_EXECUTOR": "in_process",
        "FAKE_LOG": tmp_path / "ran",
    }.items():
        monkeypatch.setenv(name, str(value))
    monkeypatch.setattr("flows.inline.RETRY_DELAY_S", 0.0)
    return tmp_path / "ran"


def test_both_engines_write_the_same_package_and_share_their_steps(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = job("twin", tmp_path)
    convert_job(wanted, tmp_path / "served")
    assert sorted(ran(log)) == sorted(EVERY_STEP)
    _, cached = convert_inline(wanted, tmp_path / "reused")
    assert cached and ran(log) == []
    with monkeypatch.context() as patch:
        patch.setenv("DG4D_HOME", str(tmp_path / "elsewhere"))
        convert_inline(job("twin", tmp_path), tmp_path / "alone")
        assert sorted(ran(log)) == sorted(EVERY_STEP)
    served, alone = (tree(tmp_path / name, *RUN_FACTS) for name in ("served", "alone"))
    assert served == alone == tree(tmp_path / "reused", *RUN_FACTS)
    records = [json.loads((tmp_path / name / "provenance.json").read_text()) for name in ("served", "alone")]
    for record in records:
        del record["run"]
    assert records[0] == records[1]


def test_steps_of_an_inline_run_are_cached_for_the_flow(log: Path, tmp_path: Path) -> None:
    wanted = job("inline first", tmp_path)
    convert_inline(wanted, tmp_path / "first")
    ran(log)
    _, cached = convert_job(wanted, tmp_path / "second")
    assert cached and ran(log) == []


def test_prefect_reads_the_records_of_inline_runs(alone: Path, tmp_path: Path) -> None:
    convert_inline(job("recorded", tmp_path), tmp_path / "out")
    record = next(home.records().glob("prepare_subject-*"))
    read: ResultRecord[Subject] = ResultRecord.deserialize(record.read_bytes())
    assert isinstance(read.result, Subject) and read.result.outputs == read_record(record).outputs  # type: ignore[union-attr]


def test_a_conversion_imports_no_prefect(alone: Path, tmp_path: Path) -> None:
    (tmp_path / "x.png").write_text(picture("light"))
    program = (
        "import sys; from pathlib import Path; from flows import home; from flows.inline import convert_inline\n"
        "from flows.inputs.conversion_job import ConversionRequest; from steps.profiles import PREVIEW\n"
        "job = ConversionRequest(item='x', picture=Path('x.png'), settings=PREVIEW).to_job(home.store())\n"
        "convert_inline(job, Path('out'))\n"
        "assert not {'prefect', 'sqlalchemy', 'fastapi'} & set(sys.modules)"
    )
    folder = str(Path(__file__).parent)
    subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path.insert(0, {folder!r})\n{program}"], cwd=tmp_path, check=True
    )
    assert (tmp_path / "out" / "asset.glb").exists()


def test_a_second_run_computes_nothing_and_a_change_only_what_depends_on_it(alone: Path, tmp_path: Path) -> None:
    convert_inline(job("once", tmp_path), tmp_path / "out")
    ran(alone)
    assert convert_inline(job("once", tmp_path), tmp_path / "again")[1] and ran(alone) == []
    convert_inline(job("once", tmp_path, **{"gates.silhouette_least": 0.5}), tmp_path / "changed")
    assert ran(alone) == ["check_asset"]


def test_a_damaged_artifact_is_computed_again(alone: Path, tmp_path: Path) -> None:
    convert_inline(job("heal", tmp_path), tmp_path / "out")
    ran(alone)
    motion = read_record(next(home.records().glob("fit_motion-*")))
    assert motion is not None
    path = home.store().path(motion.outputs["motion"])
    path.chmod(0o644)
    path.write_bytes(b"torn")
    convert_inline(job("heal", tmp_path), tmp_path / "again")
    assert "fit_motion" in ran(alone) and store_is_sound()


def test_a_mesh_per_frame_is_divided_and_joined(alone: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_CPUS", "3")
    convert_inline(job("parts", tmp_path, **{"mesh.mode": "per_frame"}), tmp_path / "out")
    steps = ran(alone)
    assert (steps.count("extract_mesh"), steps.count("join_meshes")) == (3, 1)
    monkeypatch.setenv("DG4D_CPUS", "1")
    convert_inline(job("parts", tmp_path, **{"mesh.mode": "per_frame"}), tmp_path / "one")
    assert (tmp_path / "one" / "asset.glb").read_bytes() == (tmp_path / "out" / "asset.glb").read_bytes()


@pytest.mark.parametrize(("mode", "extracted", "joined"), [("auto", 3, 1), ("tracked", 1, 0)])
def test_one_mesh_that_loses_the_video_gives_way_to_a_mesh_per_frame(
    alone: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str, extracted: int, joined: int
) -> None:
    monkeypatch.setenv("DG4D_CPUS", "2")
    convert_inline(job("stumbles", tmp_path, **{"mesh.mode": mode}), tmp_path / "out")
    steps = ran(alone)
    assert (steps.count("extract_mesh"), steps.count("join_meshes")) == (extracted, joined)


@pytest.mark.parametrize(("kind", "guessed"), [("learned", True), ("geometric", False)])
def test_one_mesh_has_the_shape_that_the_learned_prior_guessed(
    alone: Path, tmp_path: Path, kind: str, guessed: bool
) -> None:
    convert_inline(job("shape", tmp_path, **{"mesh.mode": "tracked", "prior.kind": kind}), tmp_path / "out")
    steps = json.loads((tmp_path / "out" / "provenance.json").read_text())["steps"]
    inputs = {step["step"]: step["inputs"] for step in steps}
    assert ("subject" in inputs["plan_mesh"]) is ("subject" in inputs["extract_mesh"]) is guessed


@pytest.mark.parametrize(("words", "runs"), [("memory", 3), ("crash", 2), ("bad:no", 1), ("memory-once", 2)])
def test_steps_are_retried_as_often_as_by_prefect(alone: Path, tmp_path: Path, words: str, runs: int) -> None:
    events: list[StepEvent] = []
    with listening(events.append):
        if words.endswith("once"):
            convert_inline(job(f"retry fit_motion={words}", tmp_path), tmp_path / "out")
        else:
            with pytest.raises(Exception, match="fit_motion"):
                convert_inline(job(f"retry fit_motion={words}", tmp_path), tmp_path / "out")
            assert not (tmp_path / "out").exists()
    assert ran(alone).count("fit_motion") == runs
    assert [event.kind for event in events if event.kind == "failed"] == ["failed"] * (not words.endswith("once"))


def test_a_picture_given_as_a_video_is_refused(alone: Path, tmp_path: Path) -> None:
    still = job("still", tmp_path).model_copy(update={"moving": True})
    with pytest.raises(StepBadInput, match=r"--video: this is a single picture.* run `dg4d make fake.png`"):
        convert_inline(still, tmp_path / "out")


def test_a_version_that_cannot_be_kept_leaves_the_folder_as_it_was(
    alone: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    convert_inline(job("before", tmp_path), tmp_path / "out")
    before = tree(tmp_path / "out")

    def unreachable(*_: object) -> None:
        raise StoreUnreachable("the store is away")

    with monkeypatch.context() as patch:
        patch.setattr("flows.inline.keep_version", unreachable)
        request = ConversionRequest(item="fake", picture=tmp_path / "fake.png", settings=PREVIEW, seed=1)
        with pytest.raises(StoreUnreachable):
            convert_inline(request.to_job(home.store()), tmp_path / "out")
    assert tree(tmp_path / "out") == before
    assert len(versions(home.store())) == 1


def test_an_interrupted_conversion_keeps_its_steps_and_the_next_one_goes_on(alone: Path, tmp_path: Path) -> None:
    ends: list[tuple[str, str]] = []

    def interrupt(event: StepEvent) -> None:
        if event.kind == "failed" or event.text.startswith("interrupted after"):
            ends.append((event.step, event.kind))
        if event.step == "fit_motion" and event.kind == "started":
            raise KeyboardInterrupt

    with listening(interrupt), pytest.raises(KeyboardInterrupt):
        convert_inline(job("stop", tmp_path), tmp_path / "out")
    assert not resources.stopping.is_set() and not (tmp_path / "out").exists()
    assert ends == [("fit_motion", "note")]
    assert "fit_gaussians" in ran(alone)
    convert_inline(job("stop", tmp_path), tmp_path / "out")
    assert "fit_gaussians" not in ran(alone) and store_is_sound()


def test_a_listener_that_raises_ends_the_conversion_and_its_step(alone: Path, tmp_path: Path) -> None:
    class Cancelled(Exception):
        pass

    def cancel(event: StepEvent) -> None:
        if event.step == "fit_gaussians" and event.kind == "progress":
            raise Cancelled

    with listening(cancel), pytest.raises((Cancelled, StepCrashed)):
        convert_inline(job("cancel", tmp_path), tmp_path / "out")
    assert "fit_motion" not in ran(alone)


def test_a_record_is_that_of_prefect(alone: Path, tmp_path: Path) -> None:
    convert_inline(job("format", tmp_path), tmp_path / "out")
    record = next(home.records().glob("fit_motion-*"))
    result = read_record(record)
    assert result is not None
    write_record(tmp_path / "copy", result)
    assert read_record(tmp_path / "copy") == result
    metadata = json.loads(record.read_text())["metadata"]
    assert metadata == json.loads(ResultRecord.deserialize(record.read_bytes()).serialize())["metadata"]
