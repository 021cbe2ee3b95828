"""A whole batch: its order, what is tried again, what it writes, how it ends; a function stands in for all steps."""

import csv
import errno
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import FrameType, SimpleNamespace
from typing import Any

import pytest
from fake_steps import picture
from inside import inside_a_flow
from prefect.client.orchestration import get_client
from rich.console import Console
from waiting import wait_until

from flows import catalog, home, processes
from flows.catalog import convert_all
from flows.catalog_request import CatalogRequest, ready
from flows.commands.batch import batch, print_summary
from flows.engine import resources
from flows.engine.events import StepEvent, listening
from flows.inputs.conversion_job import ConversionJob, ConversionRequest
from flows.inputs.manifest import items_of
from flows.packages.summary import NOT_ACCEPTED, BatchProgress, Row, Writer
from flows.processes import locked
from flows.serving.server import Server
from flows.step_errors import StepBadInput, StepCrashed, StepOutOfMemory
from flows.ui.gallery import ROWS_SHOWN
from steps.profiles import PREVIEW
from steps.store.files import DiskFull

QUIET = Console(quiet=True)
SIGTERM = (signal.SIGTERM, 143)
SIGHUP = pytest.param(signal.SIGHUP, 129, marks=pytest.mark.slow)


@pytest.fixture(scope="module")
def place(server: Server) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DG4D_HOME", str(server.folder.parent))
        patch.setenv("DG4D_CATALOG", "fake_steps:STEPS")
        patch.setenv("DG4D_CODE_VERSION", "batch")
        patch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))
        yield


def jobs(folder: Path, *names: str) -> list[ConversionJob]:
    for name in names:
        (folder / f"{name}.png").write_text(picture(f"batch {name}"))
    requests = [ConversionRequest(item=name, picture=folder / f"{name}.png", settings=PREVIEW) for name in names]
    return [request.to_job(home.store()) for request in requests]


def test_what_died_is_tried_once_more_at_the_end_and_bad_input_is_not(place: None, tmp_path: Path) -> None:
    begun: list[str] = []

    def work(job: ConversionJob, folder: Path) -> tuple[None, bool]:
        begun.append(job.item)
        match job.item:
            case "dies" if begun.count("dies") == 1:
                time.sleep(0.3)
                raise StepOutOfMemory("fit_motion", "killed")
            case "hopeless":
                raise StepCrashed("fit_motion", "broken")
            case "bad":
                raise StepBadInput("prepare_subject", "ugly")
        return None, False

    names = ("dies", "bad", "hopeless", "fine")
    progress = BatchProgress(4)
    inside_a_flow(convert_all, jobs(tmp_path, *names), tmp_path, 1, "retries", progress, work=work)
    assert begun == [*names, "dies", "hopeless"]
    assert {row.item: (row.status, row.attempts) for row in progress.rows.values()} == {
        "dies": ("done", 2),
        "bad": ("failed", 1),
        "hopeless": ("failed", 2),
        "fine": ("done", 1),
    }
    assert "retried" not in progress.rows["hopeless"].message
    assert progress.rows["dies"].wall_s >= 0.3  # of both attempts


def test_a_refusal_ends_a_strict_batch_and_leaves_the_reasons_of_crashed_items(
    place: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def work(job: ConversionJob, folder: Path) -> tuple[None, bool]:
        if job.item == "dies":
            raise StepCrashed("fit_motion", "killed by signal 11")
        return None, False

    refused = {"status": "failed", "kind": NOT_ACCEPTED}
    monkeypatch.setattr(
        "flows.catalog.with_verdict", lambda row, *_: row.model_copy(update=refused if row.item == "poor" else {})
    )
    progress = BatchProgress(3)
    todo = jobs(tmp_path, "dies", "poor", "late")
    inside_a_flow(convert_all, todo, tmp_path, 1, "strict", progress, strict=True, work=work)
    assert {row.item: (row.status, row.kind, row.attempts) for row in progress.rows.values()} == {
        "dies": ("failed", "StepCrashed", 1),
        "poor": ("failed", NOT_ACCEPTED, 1),
        "late": ("skipped", "", 0),
    }
    assert progress.rows["dies"].message == "killed by signal 11 (not retried: poor was not accepted)"


def test_items_are_prepared_one_ahead_of_those_at_work(place: None, tmp_path: Path) -> None:
    finished, ahead = 0, []

    def work(job: ConversionJob, folder: Path) -> tuple[None, bool]:
        nonlocal finished
        time.sleep(0.05)
        finished += 1
        return None, False

    def todo() -> Iterator[ConversionJob]:
        for drawn, job in enumerate(jobs(tmp_path, *"abcdefgh"), 1):
            ahead.append(drawn - finished)
            yield job

    progress = BatchProgress(8)
    inside_a_flow(convert_all, todo(), tmp_path, 2, "ahead", progress, work=work)
    assert max(ahead) <= 3
    assert [row.status for row in progress.rows.values()] == ["done"] * 8


def test_meshing_of_one_item_overlaps_fitting_of_the_next_and_fits_never_overlap(
    place: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    monkeypatch.setenv("DG4D_CPUS", "1")
    fits, second_fit, mutex = 0, threading.Event(), threading.Lock()
    most = 0

    def work(job: ConversionJob, folder: Path) -> tuple[None, bool]:
        nonlocal fits, most
        with resources.slot("gpu", lambda text: None):
            with mutex:
                fits += 1
                most = max(most, fits)
            if job.item == "second":
                second_fit.set()
            time.sleep(0.2)
            with mutex:
                fits -= 1
        with resources.slot("cpu", lambda text: None):
            if job.item == "first":
                assert second_fit.wait(30), "nothing is fitted while a mesh is made"
        return None, False

    progress = BatchProgress(2)
    inside_a_flow(convert_all, jobs(tmp_path, "first", "second"), tmp_path, 2, "overlap", progress, work=work)
    assert [row.status for row in progress.rows.values()] == ["done", "done"]
    assert most == 1


def test_the_server_shows_how_far_a_batch_is_and_a_page_that_can_be_read(place: None, tmp_path: Path) -> None:
    rows = [Row(item=f"{i:04d}", status="unchanged") for i in range(3 * ROWS_SHOWN)]
    (one,) = jobs(tmp_path, "zebra")

    def work(job: ConversionJob, folder: Path) -> tuple[None, bool]:
        raise StepBadInput("prepare_subject", "ugly")

    progress = BatchProgress(len(rows) + 1)
    inside_a_flow(convert_all, [*rows, one], tmp_path, 1, "many: 301 items", progress, work=work)
    with get_client(sync_client=True) as client:
        wanted = {"artifacts": {"key": {"like_": "catalog-many-"}}, "limit": 10}
        pages: list[Any] = client.request("POST", "/artifacts/latest/filter", json=wanted).json()
    by_type = {page["type"]: page for page in pages}
    assert sorted(by_type) == ["markdown", "progress"]
    table = [line for line in by_type["markdown"]["data"].splitlines() if line.startswith("| ")][1:]
    assert len(table) == ROWS_SHOWN
    assert table[0].split("|")[2:4] == [" zebra ", " failed "]  # what failed comes first
    assert by_type["progress"]["data"] == 100
    assert "301 of 301 items, 1 failed" in by_type["progress"]["description"]
    assert "all are in summary.csv" in by_type["markdown"]["data"]


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, 130), pytest.param(*SIGTERM, marks=pytest.mark.slow), SIGHUP]
)
def test_a_user_who_stops_a_batch_keeps_what_is_done(
    place: None, tmp_path: Path, number: signal.Signals, status: int
) -> None:
    (tmp_path / "in").mkdir()
    for name, words in {"a": "quick", "b": "fit_motion=sleep:300", "c": "never"}.items():
        (tmp_path / "in" / f"{name}.png").write_text(picture(f"stopped by {number.name} {words}"))
    log = tmp_path / "ran"
    command = start(tmp_path, "batch", "in", "-o", "out")
    wait_until(lambda: log.exists() and log.read_text().split().count("fit_motion") == 2)
    command.send_signal(number)
    _, trouble = command.communicate(timeout=120)
    assert command.returncode == status, trouble
    assert "run the same command again to continue" in trouble
    assert log.read_text().split().count("fit_motion") == 2  # what was stopped is not begun again
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert {row["item"]: row["status"] for row in summary["items"]} == {"a": "done", "b": "skipped", "c": "skipped"}
    assert (tmp_path / "out" / "a" / "asset.glb").is_file()
    assert left_behind(tmp_path) == []


def test_a_batch_goes_on_after_items_that_nothing_can_be_made_of(place: None, tmp_path: Path) -> None:
    names = [b"a.png", b"caf\xe9.png", b"{0}{item}.png", b"x" * 251 + b".png", b"summary.csv.png", b"z.png"]
    (tmp_path / "in").mkdir()
    for name in names:
        (tmp_path / "in" / os.fsdecode(name)).write_text(picture(f"goes on {ascii(name)[:20]}"))
    command = start(tmp_path, "batch", "in", "-o", "out", "--workers", "2")
    told, trouble = command.communicate(timeout=300)
    assert (command.returncode, "Traceback" in told + trouble) == (1, False), trouble
    items = json.loads((tmp_path / "out" / "summary.json").read_text())["items"]
    assert {row["item"] for row in items if row["status"] == "done"} == {"a", "{0}{item}", "z"}
    assert {row["kind"] for row in items if row["status"] == "failed"} == {"BadInput"}
    assert len(items) == len(names)
    made = {path.parent.name for path in (tmp_path / "out").glob("*/asset.glb")}
    assert made == {"a", "{0}{item}", "z"}


@pytest.mark.parametrize("step", ["fit_motion", "extract_mesh"])  # one alone, and several parts side by side
@pytest.mark.parametrize(("number", "status"), [SIGTERM, SIGHUP])
def test_a_signal_ends_a_command_and_its_step_and_leaves_nothing_behind(
    place: None, tmp_path: Path, number: signal.Signals, status: int, step: str
) -> None:
    (tmp_path / "a.png").write_text(picture(f"ended by {number.name} {step}=sleep:300"))
    log = tmp_path / "ran"
    command = start(tmp_path, "make", "a.png", "--set", "mesh.mode=per_frame", "-o", "out")
    wait_until(lambda: log.exists() and step in log.read_text())
    begun = time.monotonic()
    command.send_signal(number)
    _, trouble = command.communicate(timeout=60)
    assert (command.returncode, "Traceback" in trouble) == (status, False), trouble
    assert trouble.strip().endswith(
        "dg4d: stopped; run the same command again to continue after the last finished step"
    )
    assert time.monotonic() - begun < 30
    assert not (tmp_path / "out").exists()
    assert left_behind(tmp_path) == []


@pytest.mark.slow
def test_a_command_that_is_to_survive_its_terminal_does(place: None, tmp_path: Path) -> None:
    (tmp_path / "a.png").write_text(picture("nohup fit_motion=sleep:3"))
    log = tmp_path / "ran"
    command = start(tmp_path, "make", "a.png", "-o", "out", survives=True)
    wait_until(lambda: log.exists() and "fit_motion" in log.read_text())
    command.send_signal(signal.SIGHUP)
    _, trouble = command.communicate(timeout=120)
    assert command.returncode == 0, trouble


def start(folder: Path, *arguments: str, survives: bool = False) -> subprocess.Popen[str]:
    """Begin a command in a folder, with steps in processes of their own and temporary files in the folder `tmp`."""
    (folder / "tmp").mkdir()
    deaf = ("sh", "-c", 'trap "" HUP; exec "$@"', "sh") if survives else ()  # as nohup does
    return subprocess.Popen(
        [*deaf, sys.executable, "-m", "flows.cli", *arguments],
        cwd=folder,
        env={
            **os.environ, "FAKE_LOG": str(folder / "ran"), "DG4D_EXECUTOR": "subprocess", "TMPDIR": str(folder / "tmp"),
        },
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )  # fmt: skip


def left_behind(folder: Path) -> list[str]:
    """List what an ended command has left: steps at work, temporary files, scratch folders, locks that are held."""
    deadline = time.monotonic() + 60
    while steps_of(folder) and time.monotonic() < deadline:  # what was killed takes a moment to go
        time.sleep(0.1)
    left = [f"process {pid}" for pid in steps_of(folder)]
    left += [str(path) for path in (folder / "tmp").rglob("dg4d-*")]
    left += [str(path) for path in (home.locks().parent / "scratch").glob("*")]
    for lock in home.locks().rglob("*"):
        with locked(lock) as free:
            left += [] if free else [str(lock)]
    return left


def steps_of(folder: Path) -> list[int]:
    """Processes whose environment names the log of this folder."""
    mark = f"FAKE_LOG={folder / 'ran'}".encode()
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if mark in (place / "environ").read_bytes():
                found.append(int(place.name))
    return found


def test_a_made_batch_needs_no_server_and_says_that_there_is_nothing_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "home"))
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.png").write_text(picture("x"))
    monkeypatch.setattr("flows.catalog_request.is_up_to_date", lambda folder, digest: True)

    monkeypatch.setattr("flows.convert.connect", lambda: pytest.fail("nothing is to be made"))
    rows = batch(CatalogRequest(inputs=str(tmp_path / "in"), out=tmp_path / "out"), QUIET)
    assert [row.status for row in rows] == ["unchanged"]


def test_a_step_of_an_item_is_recorded_when_it_ends(log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flows.convert.connect", lambda: None)
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.png").write_text(picture(f"recorded {tmp_path}"))
    before, recorded = set(home.records().rglob("*")), []

    def note(event: StepEvent) -> None:
        if (event.step, event.kind) == ("fit_motion", "started"):
            recorded.append(len(set(home.records().rglob("*")) - before))

    with listening(note):
        batch(CatalogRequest(inputs=str(tmp_path / "in"), out=tmp_path / "out"), QUIET)
    assert recorded == [3]  # prepare_subject, drive_video, fit_gaussians


def test_a_manifest_is_read_once(place: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.png").write_text(picture("x"))
    (tmp_path / "list.csv").write_text("path\na.png\n")
    read: list[Any] = []
    monkeypatch.setattr("flows.catalog_request.items_of", lambda *given: read.append(given) or items_of(*given))
    monkeypatch.setattr("flows.catalog.convert_all", lambda todo, *_: read.extend(job.item for job in todo))
    request = CatalogRequest(inputs=str(tmp_path / "list.csv"), out=tmp_path / "out")
    inside_a_flow(lambda: batch(request, QUIET))
    assert read[1:] == ["a"]


def test_a_hundred_items_are_found_unchanged_in_a_moment_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "home"))
    monkeypatch.delenv("DG4D_CODE_VERSION", raising=False)
    (tmp_path / "in").mkdir()
    for i in range(100):
        (tmp_path / "in" / f"{i}.png").write_text(picture(str(i)))
        (tmp_path / "out" / f"{i}").mkdir(parents=True)
    found = items_of(tmp_path / "in", tmp_path / "out", "preview", {}, 0)
    ready(found[0], tmp_path / "out", strict=False)  # reads the source
    for item in found:
        job = ready(item, tmp_path / "out", strict=False)
        assert isinstance(job, ConversionJob)
        record = {"order": job.digest(), "files": {}}
        (tmp_path / "out" / item.name / "provenance.json").write_text(json.dumps(record))
    start = time.process_time()
    rows = [ready(item, tmp_path / "out", strict=False) for item in found]
    seconds = time.process_time() - start
    assert all(isinstance(row, Row) and row.status == "unchanged" for row in rows)
    assert seconds < 100 * 0.06  # 1,000 in a minute; measured 0.3 s


@pytest.mark.parametrize(
    ("rows", "status", "says"),
    [
        ([Row(item="a", status="done"), Row(item="b", status="unchanged")], 0, "2 of 2 items"),
        ([Row(item="a", status="done", failing=["motion"])], 0, "not accepted: a: motion"),
        ([Row(item="a", status="failed", kind=NOT_ACCEPTED, failing=["motion"])], 1, "1 of 1 items"),
        ([Row(item="a", status="failed", kind="StepCrashed"), Row(item="b", status="done")], 1, "1 of 2 items"),
        ([Row(item="a", status="failed", kind="BadInput"), Row(item="b", status="done")], 1, "1 of 2 items"),
        ([Row(item="a", status="failed", kind="BadInput")], 65, "0 of 1 items"),
        ([Row(item=kind, status="failed", kind=kind) for kind in ("DiskFull", "StepDiverged")], 65, "0 of 2 items"),
        ([Row(item="a", status="failed", kind="StepMissing")], 69, "0 of 1 items"),
        ([Row(item=kind, status="failed", kind=kind) for kind in ("BadInput", "StepMissing")], 1, "0 of 2 items"),
        ([Row(item="a", status="failed", kind="StepCrashed")], 1, "failed: a"),
        ([Row(item="a", status="unchanged")], 0, "nothing to do: every item is up to date"),
    ],
)
def test_the_exit_status_says_how_a_batch_ended(
    rows: list[Row], status: int, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert print_summary(rows, tmp_path, Console(soft_wrap=True)) == status
    assert says in capsys.readouterr().out


def test_a_summary_has_times_and_costs_by_item_and_in_total(tmp_path: Path) -> None:
    rows = [
        Row(item="a", status="done", compute_s=1800, cpu_s=3000.5, gpu_s=900, failing=["motion", "floaters"]),
        Row(item="b", status="unchanged", compute_s=180, cpu_s=200),
        Row(item="c", status="failed", message='a "bad", thing'),
    ]
    Writer(tmp_path, price_per_hour=2.0).write(rows, 12.34)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["totals"] == {"compute_s": 1980, "cpu_s": 3200.5, "gpu_s": 900, "cost": 1.1}
    assert [item["cost"] for item in summary["items"]] == [1.0, 0.1, 0.0]
    assert (summary["made"], summary["wall_s"], summary["price_per_hour"]) == (2, 12.3, 2.0)
    with (tmp_path / "summary.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert [line["item"] for line in lines] == ["a", "b", "c"]
    assert (lines[0]["gpu_s"], lines[0]["cost"], lines[0]["failing"]) == ("900.0", "1.0", "motion floaters")
    assert lines[2]["message"] == 'a "bad", thing'
    Writer(tmp_path).write(rows, 1.0)
    assert json.loads((tmp_path / "summary.json").read_text())["totals"]["cost"] is None


@pytest.mark.parametrize("error", [OSError(errno.ESTALE, "Stale file handle"), DiskFull("the disk is full")])
def test_a_summary_that_cannot_be_written_for_a_moment_ends_no_batch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fail(*_: object) -> None:
        raise error

    writer, rows = Writer(tmp_path), [Row(item="a", status="done")]
    with monkeypatch.context() as away:
        away.setattr("flows.packages.summary.write_atomically", fail)
        writer.write_sometimes(rows, 1.0)
        with pytest.raises(type(error)):
            writer.write(rows, 1.0)
    writer.write(rows, 1.0)
    assert (tmp_path / "summary.json").is_file()


def test_a_batch_of_thousands_is_summed_up_now_and_then_and_its_page_loads_what_is_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writes = 0

    def counted(path: Path, text: str) -> None:
        nonlocal writes
        writes += 1
        path.write_text(text)

    monkeypatch.setattr("flows.packages.summary.write_atomically", counted)
    writer, rows = Writer(tmp_path), []
    for i in range(1000):
        (tmp_path / f"{i}").mkdir()
        (tmp_path / f"{i}" / "preview.webp").touch()
        rows.append(Row(item=f"{i}", status="done"))
        writer.write_sometimes(rows, 1.0)
    assert writes < 60  # three files, every few seconds
    writer.write(rows, 1.0)
    page = (tmp_path / "index.html").read_text()
    assert page.count("<img ") == page.count('loading="lazy"') == 1000
    assert "autoplay" not in page


def test_a_line_says_how_far_a_batch_is_and_when_it_will_be_done(monkeypatch: pytest.MonkeyPatch) -> None:
    progress = BatchProgress(103)
    for i in range(3):
        progress.settle(Row(item=f"old {i}", status="unchanged"))
    assert progress.line() == "3 of 103 items, 0 failed"
    for i in range(10):
        progress.settle(Row(item=f"{i}", status="failed" if i == 4 else "done"))
    monkeypatch.setattr(BatchProgress, "seconds", property(lambda self: 600.0))
    assert progress.line() == "13 of 103 items, 1 failed, 60 an hour, about 90 min left"


def test_formulas_in_a_summary_are_text_and_numbers_are_numbers(tmp_path: Path) -> None:
    names = ["=cmd|calc!A1", "@SUM(1)", "+1", "-1", "plain"]
    rows = [Row(item=name, source=name, status="failed", message=name, compute_s=1.5) for name in names]
    Writer(tmp_path, price_per_hour=-3600.0).write(rows, 1.0)
    with (tmp_path / "summary.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    for line, name in zip(lines, names, strict=True):
        expected = name if name == "plain" else f"'{name}"
        assert (line["item"], line["source"], line["message"]) == (expected, expected, expected)
        assert (float(line["cost"]), float(line["compute_s"])) == (-1.5, 1.5)
    assert [item["item"] for item in json.loads((tmp_path / "summary.json").read_text())["items"]] == names
    Writer(tmp_path).write([Row(item="<img src=x>", status="failed", message="<b>no</b>")], 1.0)
    page = (tmp_path / "index.html").read_text()
    assert "<img" not in page and "<b>" not in page and "&lt;b&gt;no" in page


def test_a_signal_that_is_lost_while_a_catalog_runs_is_sent_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Stop(BaseException):
        """Exception of the handler of the flow."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise Stop

    def todo() -> Iterator[Row]:
        with pytest.raises(Stop):  # stands for a finalizer, which swallows what it raises
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(5)
        time.sleep(5)
        yield Row(item="late", status="done")

    monkeypatch.setattr(processes, "REMINDER_S", 0.05)
    monkeypatch.setattr(catalog, "Gallery", lambda *_: SimpleNamespace(update=lambda: None))
    progress = BatchProgress(1)
    before = signal.signal(signal.SIGTERM, stop)
    try:
        with pytest.raises(Stop):
            convert_all(todo(), tmp_path, 1, "lost", progress)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert not progress.rows
