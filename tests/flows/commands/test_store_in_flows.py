"""Flows and their store, with a real server and fake steps: damage, garbage collection, unreachable buckets."""

import json
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from conversions import RUN_FACTS, job, ran, store_is_sound, tree
from tiny_s3 import BUCKET, TinyS3
from waiting import retry_after

from flows import home
from flows.convert import convert_job
from flows.engine.collecting import collect
from flows.engine.versions import Version, versions
from flows.packages.publish import load_verified
from flows.serving.server import Server
from flows.step_errors import StepLost, StepUnreachable
from steps.store.artifact_store import object_name


@pytest.fixture
def log(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Log of fake steps; each test has its own records and store."""
    monkeypatch.setenv("FAKE_LOG", str(tmp_path / "ran"))
    monkeypatch.setenv("DG4D_CATALOG", "fake_steps:STEPS")
    monkeypatch.setenv("DG4D_CODE_VERSION", "test")
    monkeypatch.setenv("DG4D_EXECUTOR", "in_process")
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "home"))
    retry_after(0.01, monkeypatch)
    return tmp_path / "ran"


@pytest.fixture
def bucket(log: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[TinyS3]:
    """S3-compatible store of the test."""
    running = TinyS3()
    for name, value in running.environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("DG4D_STORE", f"s3://{BUCKET}/{time.monotonic_ns()}")
    yield running
    running.stop()


def damage(digest: str, how: str) -> None:
    path = home.store().root / object_name(digest)
    path.chmod(0o644)
    match how:
        case "gone":
            path.unlink()
        case "flipped":
            content = path.read_bytes()
            path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
        case "short":
            os.truncate(path, path.stat().st_size - 1)


def the_version() -> Version:
    (version,) = versions(home.store())
    return version


def test_a_finished_order_is_a_version_and_the_same_order_again_is_the_same(log: Path, tmp_path: Path) -> None:
    wanted = job("version", tmp_path)
    convert_job(wanted, tmp_path / "out")
    made = the_version()
    record = json.loads((tmp_path / "out" / "provenance.json").read_text())
    assert (made.item, made.order, made.package.digest) == ("fake", record["order"], record["package"])
    assert [step.record for step in made.steps] == [step["digest"] for step in record["steps"]]
    assert store_is_sound()
    convert_job(wanted, tmp_path / "again")
    assert the_version().steps == made.steps
    convert_job(job("another version", tmp_path), tmp_path / "out")
    assert len(versions(home.store())) == 2
    assert list(home.store().entries("running")) == []


@pytest.mark.parametrize("how", ["gone", "flipped", pytest.param("short", marks=pytest.mark.slow)])
def test_whatever_is_damaged_between_two_runs_is_made_again(log: Path, tmp_path: Path, how: str) -> None:
    convert_job(job("damage", tmp_path), tmp_path / "one")
    every = ran(log)
    assert len(set(every)) == len(every) > 5
    for digest in the_version().artifacts():
        damage(digest, how)
    convert_job(job("damage", tmp_path), tmp_path / "two")
    again = ran(log)  # what one step makes anew another may share
    assert again and set(again) <= set(every)
    assert store_is_sound()
    assert tree(tmp_path / "one", *RUN_FACTS) == tree(tmp_path / "two", *RUN_FACTS)
    load_verified(tmp_path / "two")
    only = next(step for step in the_version().steps if step.label == "fit_motion").outputs["motion"]
    damage(only, how)
    convert_job(job("damage", tmp_path), tmp_path / "three")
    assert ran(log) == ["fit_motion"]
    assert tree(tmp_path / "one", *RUN_FACTS) == tree(tmp_path / "three", *RUN_FACTS)


def test_what_is_damaged_while_a_flow_runs_is_made_again(log: Path, tmp_path: Path) -> None:
    wanted = job("midway fit_motion=sleep-once:1", tmp_path)

    def spoil() -> None:
        while not log.exists() or "fit_motion" not in log.read_text():
            time.sleep(0.02)
        subject = json.loads(next(home.records().glob("prepare_subject-*")).read_text())["result"]
        damage(json.loads(subject)["data"]["outputs"]["subject"]["digest"], "flipped")

    spoiler = threading.Thread(target=spoil)
    spoiler.start()
    convert_job(wanted, tmp_path / "out")
    spoiler.join()
    assert sorted(set(ran(log))) != ["prepare_subject"]
    assert store_is_sound()
    load_verified(tmp_path / "out")


def test_a_source_that_is_gone_is_an_error_and_not_a_loop(log: Path, tmp_path: Path) -> None:
    wanted = job("gone", tmp_path)
    damage(wanted.source.digest, "gone")
    with pytest.raises(StepLost, match="run the same command again"):
        convert_job(wanted, tmp_path / "out")
    convert_job(job("gone", tmp_path), tmp_path / "out")


def test_removing_all_the_time_harms_no_run(log: Path, tmp_path: Path) -> None:
    convert_job(job("busy", tmp_path), tmp_path / "one")
    ran(log)
    store = home.store()
    store.remove([the_version().name])
    for entry in store.entries("sha256"):  # all is old, and no version needs it
        os.utime(store.root / entry.name, (0, 0))
    wanted, done, removed = job("busy", tmp_path), threading.Event(), []

    def remove() -> None:
        while not done.is_set():
            removed.append(len(collect(store, home.records(), grace_s=60).artifacts))
            time.sleep(0.01)

    remover = threading.Thread(target=remove)
    remover.start()
    convert_job(wanted, tmp_path / "two")
    done.set()
    remover.join()
    assert len(removed) > 1
    assert sum(removed) > 0
    assert store_is_sound()
    assert tree(tmp_path / "one", *RUN_FACTS) == tree(tmp_path / "two", *RUN_FACTS)


def test_a_bucket_gives_the_same_as_a_folder(bucket: TinyS3, log: Path, tmp_path: Path) -> None:
    convert_job(job("bucket", tmp_path), tmp_path / "one")
    every = ran(log)
    assert set(the_version().artifacts()) == {entry.name for entry in home.store().artifacts()}
    for path in (tmp_path / "home" / "copies").rglob("*"):
        if path.is_file():
            path.unlink()
    convert_job(job("bucket", tmp_path), tmp_path / "two")
    assert ran(log) == []
    assert tree(tmp_path / "one", *RUN_FACTS) == tree(tmp_path / "two", *RUN_FACTS)
    os.environ.pop("DG4D_STORE")
    convert_job(job("bucket", tmp_path), tmp_path / "three")
    again = ran(log)
    assert again and set(again) <= set(every)
    assert tree(tmp_path / "one", *RUN_FACTS) == tree(tmp_path / "three", *RUN_FACTS)


def test_a_bucket_that_goes_away_for_a_while_delays_a_flow_and_no_more(
    bucket: TinyS3, log: Path, tmp_path: Path
) -> None:
    wanted = job("away fit_motion=sleep-once:0.5", tmp_path)
    absence = threading.Thread(target=_absent, args=(bucket, log, "fit_motion", 1.5))
    absence.start()
    convert_job(wanted, tmp_path / "out")
    absence.join()
    done = ran(log)
    assert len(set(done)) == len(done)  # the result was there and waited
    assert store_is_sound()


def test_a_step_that_lost_patience_with_the_bucket_is_tried_again(
    bucket: TinyS3, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("steps.store.opening.PATIENCE_S", 0.1)
    retry_after(3.0, monkeypatch)
    wanted = job("patience fit_motion=sleep-once:0.3", tmp_path)
    absence = threading.Thread(target=_absent, args=(bucket, log, "fit_motion", 2.0))
    absence.start()
    convert_job(wanted, tmp_path / "out")
    absence.join()
    assert sorted(ran(log)).count("fit_motion") == 2
    assert store_is_sound()


def test_a_bucket_that_stays_away_is_a_clear_error_and_the_next_run_goes_on(
    bucket: TinyS3, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("steps.store.opening.PATIENCE_S", 0.1)
    wanted = job("stays-away fit_motion=sleep-once:0.3", tmp_path)
    absence = threading.Thread(target=_absent, args=(bucket, log, "fit_motion", 0))
    absence.start()
    with pytest.raises(StepUnreachable, match="does not answer"):
        convert_job(wanted, tmp_path / "out")
    absence.join()
    assert not (tmp_path / "out").exists()
    ran(log)
    bucket.start()
    convert_job(wanted, tmp_path / "out")
    assert ran(log)[:2] == ["fit_motion", "plan_mesh"]


def _absent(bucket: TinyS3, log: Path, step: str, seconds: float) -> None:
    """Stop the server when a step starts; restart it after some seconds, if given."""
    while not log.exists() or step not in log.read_text():
        time.sleep(0.02)
    bucket.stop()
    if seconds:
        time.sleep(seconds)
        bucket.start()
