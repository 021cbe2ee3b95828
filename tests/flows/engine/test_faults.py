"""Fault injection with a real server and fake steps: killed processes, full disks, lost databases."""

import json
import os
import signal
import sqlite3
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import fake_steps
import pytest
from conversions import EVERY_STEP, RUN_FACTS, job, ran, store_is_sound, tree
from fake_steps import picture
from obstore.store import LocalStore
from postgresql import server_on_postgresql
from prefect.client.orchestration import get_client
from prefect.settings import PREFECT_API_URL, PREFECT_CLIENT_SERVER_VERSION_CHECK_ENABLED, temporary_settings
from rich.console import Console
from waiting import retry_after, start, wait_until

from dg4d_lib.errors import BadInput
from flows import home
from flows.catalog_request import CatalogRequest
from flows.commands.batch import batch
from flows.convert import convert_job
from flows.engine import leases
from flows.engine.collecting import collect
from flows.engine.orphans import settle_orphans
from flows.engine.step_tasks import RETRIES
from flows.packages.publish import load_verified
from flows.serving.server import Server, answers
from flows.step_errors import StepBadInput, StepOutOfMemory, StepTimedOut
from steps.store.bucket import BucketStore

STAGES = [EVERY_STEP[:1], EVERY_STEP[1:3], *([step] for step in EVERY_STEP[3:])]  # of parallel steps
DAY_S = 86400.0
AWAY_S = 3.0  # restart of a database


@pytest.fixture
def log(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Log of fake steps in this process and its children; they use the home folder of the server."""
    monkeypatch.setenv("DG4D_HOME", str(server.folder.parent))
    monkeypatch.setenv("DG4D_STORE", str(tmp_path / "store"))
    monkeypatch.setenv("DG4D_CATALOG", "fake_steps:STEPS")
    monkeypatch.setenv("DG4D_CODE_VERSION", tmp_path.name)  # no cached results
    monkeypatch.setenv("DG4D_EXECUTOR", "in_process")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))
    monkeypatch.setenv("FAKE_LOG", str(tmp_path / "ran"))
    retry_after(0.01, monkeypatch)
    return tmp_path / "ran"


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """Folder on a disk of 256 KiB."""
    place = tmp_path / "disk"
    place.mkdir()
    if _mount("-t", "tmpfs", "-o", "size=256k", "tmpfs", place) != 0:
        pytest.skip("a file system of a chosen size cannot be mounted here (it takes root)")
    yield place
    subprocess.run(["umount", str(place)], check=True)


def during(step: str, log: Path, do: Callable[[], None]) -> threading.Thread:
    """Call a function in a thread as soon as a step runs."""

    def wait_and_do() -> None:
        wait_until(lambda: log.exists() and step in log.read_text())
        do()

    thread = threading.Thread(target=wait_and_do)
    thread.start()
    return thread


@pytest.mark.slow
def test_a_command_killed_in_every_stage_ends_with_the_bytes_of_an_undisturbed_one(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settle_orphans()
    monkeypatch.setenv("DG4D_CPUS", "2")
    words = " ".join(f"{step}=sleep-once:120" for step in EVERY_STEP)
    (tmp_path / "fake.png").write_text(picture(words))
    before: list[str] = []
    for stage in STAGES:
        command = start("make", str(tmp_path / "fake.png"), "-o", str(tmp_path / "out"))
        wait_until(lambda stage=stage: all((tmp_path / f"ran.{step}").exists() for step in stage))  # they sleep there
        command.send_signal(signal.SIGKILL)
        command.communicate()
        assert sorted(ran(log)) == sorted(before + stage)
        assert not (tmp_path / "out").exists()
        before = stage
    assert settle_orphans() == 1  # every command settles the one before
    convert_job(job(words, tmp_path), tmp_path / "out")
    assert ran(log) == EVERY_STEP[-1:]
    monkeypatch.delenv("DG4D_STORE")
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "fresh"))  # where nothing is done yet
    convert_job(job(words, tmp_path), tmp_path / "other")
    assert sorted(ran(log)) == sorted(EVERY_STEP)
    assert tree(tmp_path / "out", *RUN_FACTS) == tree(tmp_path / "other", *RUN_FACTS)


@pytest.mark.slow
def test_two_batches_of_the_same_folder_at_once_do_the_work_once(log: Path, tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for name in ("a", "b"):
        (tmp_path / "in" / f"{name}.png").write_text(picture(f"{name} fit_gaussians=sleep:0.5"))
    both = [start("batch", str(tmp_path / "in"), "-o", str(tmp_path / "out")) for _ in range(2)]
    for command in both:
        _, trouble = command.communicate()
        assert command.returncode == 0, trouble
    assert sorted(ran(log)) == sorted(EVERY_STEP * 2)
    for name in ("a", "b"):
        load_verified(tmp_path / "out" / name)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert sorted(row["item"] for row in summary["items"]) == ["a", "b"]
    assert [path.name for path in (tmp_path / "out").iterdir() if path.name.startswith(".")] == []
    assert store_is_sound()


def test_a_server_killed_during_a_run_is_started_again_and_the_run_goes_on(
    server: Server, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DG4D_STORE")  # the new server outlives this test and its store
    address = server.address()
    assert address is not None

    def kill() -> None:
        guard = json.loads((server.folder / "server.json").read_text())["guard"]
        children = Path(f"/proc/{guard}/task/{guard}/children").read_text().split()
        os.kill(int(children[0]), signal.SIGKILL)
        wait_until(lambda: not server.is_guarded())

    killer = during("fit_motion", log, kill)
    convert_job(job("server fit_motion=sleep-once:2", tmp_path), tmp_path / "out")
    killer.join()
    assert sorted(ran(log)) == sorted(EVERY_STEP)
    assert server.address() == address and answers(address, timeout_s=10)
    with get_client(sync_client=True) as client:
        (newest,) = client.read_flow_runs(limit=1, sort="START_TIME_DESC")  # type: ignore[arg-type]
    assert newest.name == "fake" and newest.state is not None and newest.state.is_completed()
    load_verified(tmp_path / "out")


@pytest.mark.slow
def test_a_flow_begins_again_with_a_new_server_if_the_old_one_was_killed_with_its_guard(
    server: Server, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DG4D_STORE")  # the new server outlives this test and its store
    os.kill(json.loads((server.folder / "server.json").read_text())["guard"], signal.SIGKILL)
    wait_until(lambda: server.address() is None)
    with temporary_settings({PREFECT_CLIENT_SERVER_VERSION_CHECK_ENABLED: False}):  # as in commands
        convert_job(job("guard", tmp_path), tmp_path / "out")
    assert sorted(ran(log)) == sorted(EVERY_STEP)
    load_verified(tmp_path / "out")


def test_a_database_that_is_locked_for_a_while_delays_a_run_and_no_more(
    server: Server, log: Path, tmp_path: Path
) -> None:
    database = server.folder.parent / "prefect" / "prefect.db"
    assert database.exists()
    locked_s = 4.0

    def hold() -> None:
        with sqlite3.connect(database, timeout=30, isolation_level=None) as connection:
            connection.execute("BEGIN EXCLUSIVE")
            time.sleep(locked_s)
            connection.execute("ROLLBACK")
        connection.close()

    holder = during("prepare_subject", log, hold)
    began = time.monotonic()
    convert_job(job("locked prepare_subject=sleep-once:0.5", tmp_path), tmp_path / "out")
    holder.join()
    assert time.monotonic() - began > locked_s
    assert sorted(ran(log)) == sorted(EVERY_STEP)
    load_verified(tmp_path / "out")


@pytest.mark.slow
def test_a_database_that_crashes_during_a_batch_and_comes_back_loses_and_doubles_nothing(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [str(number) for number in range(6)]
    (tmp_path / "in").mkdir()
    for name in names:
        (tmp_path / "in" / f"{name}.png").write_text(picture(f"{name} fit_motion=sleep:0.5"))
    with server_on_postgresql(tmp_path / "prefect") as (api_url, database):

        def crash() -> None:
            database.crash()
            time.sleep(AWAY_S)
            database.start()

        monkeypatch.setenv("PREFECT_API_URL", api_url)
        with temporary_settings({PREFECT_API_URL: api_url}):
            crasher = during("extract_mesh", log, crash)
            rows = batch(
                CatalogRequest(inputs=str(tmp_path / "in"), out=tmp_path / "out", workers=2), Console(quiet=True)
            )
            crasher.join()
            with get_client(sync_client=True) as client:
                runs = client.read_flow_runs()
    assert {row.item: (row.status, row.attempts) for row in rows} == dict.fromkeys(names, ("done", 1))
    assert sorted(ran(log)) == sorted(EVERY_STEP * len(names))
    assert sorted(run.name for run in runs if run.name in names) == names
    assert {run.state.name for run in runs if run.state is not None} == {"Completed"}
    for name in names:
        load_verified(tmp_path / "out" / name)
    assert store_is_sound()


def test_a_full_disk_is_a_clear_message_and_with_more_room_the_run_goes_on(
    log: Path, disk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DG4D_STORE", str(disk / "store"))
    wanted = job("x" * 60_000, tmp_path)  # every artifact is as large
    with pytest.raises(StepBadInput, match=r"disk.* full"):
        convert_job(wanted, tmp_path / "out")
    done = ran(log)
    assert 1 <= len(done) < len(EVERY_STEP)
    assert not (tmp_path / "out").exists()
    assert list((disk / "store" / "incoming").glob("*")) == []
    assert _mount("-o", "remount,size=64m", disk) == 0
    convert_job(wanted, tmp_path / "out")
    assert {*done, *ran(log)} == set(EVERY_STEP)
    assert store_is_sound()


def test_a_step_whose_memory_is_limited_is_tried_again_and_then_says_so(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DG4D_EXECUTOR", "subprocess")
    with pytest.raises(StepOutOfMemory, match=r"memory ran out: end other programs, or lower subject\.size"):
        convert_job(job("prepare_subject=hoard", tmp_path), tmp_path / "out")
    assert ran(log) == EVERY_STEP[:1] * (1 + RETRIES)


def test_a_step_that_hangs_is_killed_and_the_next_run_begins_with_it(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DG4D_EXECUTOR", "subprocess")
    patient = fake_steps.STEPS["drive_video"]
    with monkeypatch.context() as hasty:
        hasty.setitem(fake_steps.STEPS, "drive_video", patient.model_copy(update={"timeout_s": 8.0}))
        wanted = job("drive_video=sleep-once:300", tmp_path)
        began = time.monotonic()
        with pytest.raises(StepTimedOut, match="no result after 8 s, so it was stopped"):
            convert_job(wanted, tmp_path / "out")
    assert time.monotonic() - began < 200
    assert ran(log).count("drive_video") == 1  # the same again would hang again
    monkeypatch.setenv("DG4D_EXECUTOR", "in_process")
    convert_job(wanted, tmp_path / "out")
    assert "prepare_subject" not in (again := ran(log)) and "drive_video" in again


@pytest.mark.parametrize("skew_s", [-400 * DAY_S, pytest.param(400 * DAY_S, marks=pytest.mark.slow)])
def test_results_are_used_whatever_the_clock_said_when_they_were_made(log: Path, tmp_path: Path, skew_s: float) -> None:
    convert_job(job("skew", tmp_path), tmp_path / "one")
    assert sorted(ran(log)) == sorted(EVERY_STEP)
    for folder in (home.store().root, home.records()):
        for path in folder.rglob("*"):
            os.utime(path, times=(time.time() + skew_s,) * 2)
    _, cached = convert_job(job("skew", tmp_path), tmp_path / "two")
    assert cached and ran(log) == []
    assert tree(tmp_path / "one", *RUN_FACTS) == tree(tmp_path / "two", *RUN_FACTS)


@pytest.mark.parametrize("skew_s", [-400 * DAY_S, 400 * DAY_S])
def test_a_clock_that_jumps_during_a_run_makes_nothing_needed_go(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, skew_s: float
) -> None:
    convert_job(job("jump", tmp_path), tmp_path / "one")
    store, true_time = home.store(), time.time
    unwanted = store.put_bytes(b"of nobody", "text/plain")
    with leases.running(store, "fake"):
        needed = store.put_bytes(b"made by this run", "text/plain")
        monkeypatch.setattr(time, "time", lambda: true_time() + skew_s)
        collect(store, home.records())
        assert store.has(needed) and store_is_sound()
        with (
            leases.collecting(store),
            pytest.raises(BadInput, match="another `dg4d store gc`"),
            leases.collecting(store),
        ):
            pass
    collect(store, home.records())
    assert store_is_sound()
    assert store.has(unwanted) == (skew_s < 0)  # what is from the future is not old


def test_a_lock_from_the_future_on_another_machine_does_not_hold_for_ever(tmp_path: Path) -> None:
    store = BucketStore(LocalStore(tmp_path), tmp_path / "copies", "local")
    theirs = leases.Collecting(host="another", pid=1, start="1", token="t")
    store.write(leases.LOCK, theirs.model_dump_json())
    lock = tmp_path / leases.LOCK
    os.utime(lock, times=(time.time() + 60,) * 2)  # their clock is a minute ahead: they are alive
    with pytest.raises(BadInput, match="another `dg4d store gc`"), leases.collecting(store):
        pass
    os.utime(lock, times=(time.time() + 400 * DAY_S,) * 2)
    with leases.collecting(store):
        assert store.read(leases.LOCK) != theirs.model_dump_json().encode()


def _mount(*arguments: object) -> int:
    try:
        return subprocess.run(["mount", *map(str, arguments)], capture_output=True, check=False).returncode
    except FileNotFoundError:
        return 1
