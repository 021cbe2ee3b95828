"""`dg4d up` and `dg4d down`: what they leave behind, on a server that the user names."""

import os
import re
import subprocess
import sys
from pathlib import Path
from uuid import uuid4

import httpx
import pytest
import typer
from prefect.client.schemas.objects import FlowRun
from prefect.settings import PREFECT_API_URL
from prefect.states import Failed
from waiting import wait_until

from dg4d_lib.errors import BadInput
from flows import convert
from flows.commands import services
from flows.serving import background, registering, watching, workers
from flows.serving.server import Server, ServerUnavailable
from flows.serving.workers import running
from flows.ui import showing


@pytest.fixture
def folder(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the commands keep their state; the server is one that they did not start."""
    monkeypatch.setenv("DG4D_HOME", str(tmp_path))
    monkeypatch.setenv("PREFECT_API_URL", str(PREFECT_API_URL.value()))
    return tmp_path / "server"


def dg4d(*arguments: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "flows.cli", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def children(pid_file: Path) -> list[str]:
    """The processes that a guard started."""
    return Path(f"/proc/{pid_file.read_text()}/task/{pid_file.read_text()}/children").read_text().split()


@pytest.mark.slow
def test_a_worker_for_the_server_of_somebody_else_stays_until_it_is_told_to_stop(server: Server, folder: Path) -> None:
    said = dg4d("up", "--pool", "process-cpu", "--sources", str(folder.parent))
    assert said.returncode == 0, said.stderr
    *deployments, address = said.stdout.splitlines()
    assert deployments == [
        "picture-to-4d/Picture to 4D", "video-to-4d/Video to 4D", "model-to-4d/Model to 4D", "benchmark/Benchmark",
        "catalog-to-4d/Catalog to 4D",
    ]  # fmt: skip
    assert address == os.environ["PREFECT_API_URL"].removesuffix("/api")
    explained = said.stderr.splitlines()
    assert explained[0].startswith("deployments with forms") and explained[-1].startswith(
        "open this address, the Prefect UI"
    )
    try:
        wait_until(lambda: [worker.pool for worker in running(folder)] == ["process-cpu"])
        log = folder / "worker-process-cpu.log"
        wait_until(lambda: "started!" in log.read_text())
        assert running(folder)
        assert server.auth_string().partition(":")[2] not in said.stdout + said.stderr + log.read_text()
        environments = [Path(f"/proc/{pid}/environ") for pid in children(folder / "worker-process-cpu.pid")]
        assert any(f"DG4D_SOURCES={folder.parent}\0" in environ.read_text() for environ in environments)
        other = dg4d("up", "--pool", "process-cpu", "--sources", str(Path.cwd()))
        assert other.returncode == 65 and f"--sources {folder.parent}; stop it: `dg4d down`" in other.stderr
    finally:
        stopped = dg4d("down")
    ending = r"stopping worker process-cpu( and its \d+ runs?)?\nstopped\n"  # runs that other tests left on this server
    assert stopped.returncode == 0 and re.fullmatch(ending, stopped.stdout)
    assert running(folder) == []
    assert "stopped!" in log.read_text()  # it was not killed
    assert server.auth_string().partition(":")[2] not in stopped.stderr + log.read_text()
    assert dg4d("down").stdout == "nothing was running\n"


@pytest.mark.parametrize(
    ("pool", "registered", "choose"),
    [
        (
            "kubernetes-cpu",
            ["picture-to-4d/Picture to 4D on Kubernetes"],
            "Deployments, Picture to 4D on Kubernetes, Run",
        ),
        ("fleet", ["item-to-4d/Item to 4D on a fleet"], ""),
    ],
)
def test_up_names_a_deployment_that_it_registered_and_how_to_sign_in(
    pool: str, registered: list[str], choose: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setenv("DG4D_HOME", str(tmp_path))
    monkeypatch.setenv("PREFECT_API_URL", "http://server:4200/api")
    monkeypatch.setattr(convert, "connect", lambda: None)
    monkeypatch.setattr(registering, "register", lambda *_: registered)
    services.up([pool], workers=False)
    said = capsys.readouterr()
    assert said.out.splitlines()[-1] == "http://server:4200"
    advice = said.err.splitlines()[-1]
    assert "signs the browser in at /dg4d/login#NAME:PASSWORD" in advice
    assert advice.partition("; then choose ")[2] == choose


GUARD = """
import fcntl, json, os, sys, time
lock, user = (open(f"{sys.argv[1]}/{name}", "a") for name in ("guard", "in-use"))
fcntl.flock(lock, fcntl.LOCK_EX)
if sys.argv[2] == "used":
    fcntl.flock(user, fcntl.LOCK_SH)
with open(f"{sys.argv[1]}/server.json", "w") as state:
    json.dump({"guard": os.getpid(), "port": 1}, state)
print("there", flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize("use", ["used", "idle"])
def test_a_server_that_a_command_uses_does_not_end_without_a_word(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, use: str
) -> None:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path))
    (tmp_path / "server").mkdir()
    command = [sys.executable, "-c", GUARD, str(tmp_path / "server"), use]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as guard:
        assert guard.stdout is not None and guard.stdout.readline() == b"there\n"
        said = dg4d("down").stdout.splitlines()
    assert said[-1] == "stopped"
    assert any("a running command uses" in line for line in said) == (use == "used")


def test_a_pool_that_is_not_described_is_refused_before_anything_is_started(folder: Path) -> None:
    said = dg4d("up", "--pool", "process-cpo")
    assert said.returncode == 65
    assert "unknown pool 'process-cpo'" in said.stderr and "process-cpu" in said.stderr
    assert not folder.exists()


@pytest.mark.parametrize(("given", "of_pool", "limit"), [("", None, ""), ("", 2, "2"), ("3", 2, "3"), ("3", None, "3")])
def test_runs_of_a_worker_are_limited_by_its_pool_or_by_its_machine(
    given: str, of_pool: int | None, limit: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DG4D_WORKER_LIMIT", given)
    assert workers.limit(of_pool) == {"DG4D_WORKER_LIMIT": limit}
    for wrong in ("0", "many", "-1", "1.5"):
        monkeypatch.setenv("DG4D_WORKER_LIMIT", wrong)
        with pytest.raises(BadInput, match="DG4D_WORKER_LIMIT"):
            workers.limit(of_pool)


def test_a_server_is_reached_from_this_machine_only(server: Server) -> None:
    port = int(str(server.address()).rpartition(":")[2])
    tables = [table.read_text().splitlines()[1:] for table in Path("/proc/net").glob("tcp*")]
    sockets = [line.split()[1:4:2] for lines in tables for line in lines]
    listening = [place for place, state in sockets if state == "0A" and int(place.rpartition(":")[2], 16) == port]
    assert listening == [f"0100007F:{port:04X}"]


def test_other_programs_get_address_and_secret_of_a_server_that_runs(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DG4D_HOME", str(server.folder.parent))
    assert dg4d("env").stdout.splitlines() == [
        f"export PREFECT_API_URL={server.address()}/api",
        f"export PREFECT_API_AUTH_STRING={server.auth_string()}",
    ]
    monkeypatch.setenv("DG4D_HOME", str(tmp_path))
    assert dg4d("env").returncode == 69


def test_a_command_uses_the_server_that_it_connected_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path))
    for name in ("PREFECT_API_URL", "PREFECT_API_AUTH_STRING", "PREFECT_HOME"):
        monkeypatch.setenv(name, "")  # to have it restored
        monkeypatch.delenv(name)
    used: dict[Path, Server] = {}
    monkeypatch.setattr(background, "_used", used)
    monkeypatch.setattr("flows.serving.server.spawn_guard", lambda *_: None)
    monkeypatch.setattr(Server, "wait_for_address", lambda _: "http://127.0.0.1:1")
    monkeypatch.setattr(Server, "wait", lambda _: "http://127.0.0.1:1/api")
    monkeypatch.setattr("flows.engine.orphans.settle_orphans", lambda: 0)
    convert.connect()
    assert background.background_server().is_used()
    (tmp_path / "server" / "port").write_text("1")
    convert.connect()  # as for the next picture: starts the server again if it has ended
    with monkeypatch.context() as moved:
        moved.setattr(Server, "wait_for_address", lambda _: "http://127.0.0.1:2")
        with pytest.raises(ServerUnavailable, match="another program took the port"):
            convert.connect()
    used[tmp_path / "server"].release()
    assert not background.background_server().is_used()


@pytest.fixture
def inbox(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A watched folder with a picture, whose server is a stand-in."""
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "fox.png").write_bytes(b"picture")
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(services, "POLL_S", 0.0)
    monkeypatch.setattr(convert, "connect", lambda: None)
    monkeypatch.setattr(watching, "check_registered", lambda: None)
    monkeypatch.setattr(watching.FailedRuns, "_failed", lambda _: [])
    return tmp_path / "in"


def answer(status: int) -> httpx.HTTPStatusError:
    request = httpx.Request("POST", "http://127.0.0.1/api/events")
    return httpx.HTTPStatusError("refused", request=request, response=httpx.Response(status, request=request))


def test_a_watch_goes_on_while_the_server_is_away(
    inbox: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    happened: list[str] = []
    troubles = [httpx.ConnectError("away"), answer(500), answer(429)]

    def announce(folder: Path, inputs: Path, out: Path, digest: str) -> None:
        happened.append(digest)
        if troubles:
            raise troubles.pop(0)

    monkeypatch.setattr(watching, "announce", announce)
    monkeypatch.setattr(showing, "revive", lambda: happened.append("revived"))
    monkeypatch.setattr(watching.Watcher, "mark_announced", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(typer.Exit):
        services.watch(inbox, inbox.parent / "out", 0.0)
    digest = happened[0]
    assert happened == [digest, "revived", digest, "revived", digest, "revived", digest]
    assert capsys.readouterr().err.count("the server is unavailable") == 1


def test_a_watch_ends_when_the_server_refuses_its_events(
    inbox: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(watching, "announce", lambda *_: (_ for _ in ()).throw(answer(403)))
    with pytest.raises(typer.Exit):
        services.watch(inbox, inbox.parent / "out", 0.0)
    assert "is unavailable" not in capsys.readouterr().err


def test_a_watch_announces_a_manifest_and_waits_while_there_are_several(
    inbox: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    announced: list[Path] = []
    for name in ("a.csv", "b.csv"):
        (inbox / name).write_text("path\nfox.png\n")
    looks = iter(range(100))

    def sleep(_: float) -> None:
        if next(looks) == 2:
            (inbox / "b.csv").unlink()

    def announce(folder: Path, inputs: Path, out: Path, digest: str) -> None:
        announced.append(inputs)
        raise KeyboardInterrupt

    monkeypatch.setattr(watching, "announce", announce)
    monkeypatch.setattr(services.time, "sleep", sleep)
    with pytest.raises(typer.Exit):
        services.watch(inbox, inbox.parent / "out", 0.0)
    assert announced == [inbox / "a.csv"]
    assert capsys.readouterr().err.count("several manifests (a.csv, b.csv)") == 1


def test_a_watch_says_what_it_reads_and_what_goes_on_after_it(
    inbox: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def sleep(_: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(watching, "announce", lambda *_: None)
    monkeypatch.setattr(services.time, "sleep", sleep)
    with pytest.raises(typer.Exit):
        services.watch(inbox, inbox.parent / "out", 0.0)
    said = capsys.readouterr()
    assert "for pictures, videos and manifests (other files are ignored, models need a manifest)" in said.out
    assert "s: files sent to the server; finished packages are listed below\n" in said.out
    assert "stopped watching; conversions that were sent continue until `dg4d down`\n" in said.err


def test_a_slow_server_does_not_count_as_rest(inbox: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock, looks = [0.0], list[float]()

    def failed_runs(_: watching.FailedRuns) -> list[FlowRun]:
        clock[0] += 60.0
        return []

    def look(_: watching.Watcher, now: float) -> None:
        looks.append(now)
        raise KeyboardInterrupt

    monkeypatch.setattr(services.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(services, "RESULTS_EVERY_S", 0.0)
    monkeypatch.setattr(watching.FailedRuns, "_failed", failed_runs)
    monkeypatch.setattr(watching.Watcher, "poll", look)
    with pytest.raises(typer.Exit):
        services.watch(inbox, inbox.parent / "out", 10.0)
    assert looks == clock


def test_a_watch_prints_failed_runs(
    inbox: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(name: str) -> FlowRun:
        state = Failed(message=f"{name} went wrong")
        return FlowRun(flow_id=uuid4(), name=name, state=state, parameters={"out": str(inbox.parent / "out")})

    found, looks = [run("earlier")], iter(range(100))

    def sleep(_: float) -> None:
        found[:0] = [run(f"run {next(looks)}")]
        if len(found) == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(watching, "announce", lambda *_: None)
    monkeypatch.setattr(watching.FailedRuns, "_failed", lambda _: list(found))
    monkeypatch.setattr(services, "RESULTS_EVERY_S", 0.0)
    monkeypatch.setattr(services.time, "sleep", sleep)
    with pytest.raises(typer.Exit):
        services.watch(inbox, inbox.parent / "out", 0.0)
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if line.startswith("failed")] == ["failed: run run 0: run 0 went wrong"]
