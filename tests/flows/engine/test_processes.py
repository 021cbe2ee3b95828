"""Processes are told apart, also those of containers that have the name of their host; lost signals come again."""

import errno
import fcntl
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import IO

import pytest

from flows import processes
from flows.engine import resources
from flows.processes import OWN_START, host_id, locked, repeated, start_of
from flows.serving import server

HOSTNAME_TOO = "import socket; from flows.processes import host_id; print(socket.gethostname(), host_id())"


def _said(*before: str) -> list[str]:
    done = subprocess.run([*before, sys.executable, "-c", HOSTNAME_TOO], capture_output=True, text=True, check=False)
    if before and done.returncode:
        pytest.skip("a process cannot have processes of its own here (it takes root)")
    return done.stdout.split()


def test_a_process_on_this_machine_is_in_the_same_place() -> None:
    assert _said()[1] == host_id()


def test_a_process_keeps_its_place_when_the_name_of_the_host_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    before = host_id()
    monkeypatch.setattr("socket.gethostname", lambda: "in-another-network")
    assert host_id() == before
    monkeypatch.setenv("DG4D_HOST_ID", "given")
    assert host_id() == "given"


def test_a_container_with_the_name_of_its_host_is_another_place() -> None:
    name, elsewhere = _said("unshare", "--pid", "--fork")
    assert name == _said()[0]
    assert elsewhere != host_id()


def test_the_start_of_a_process_is_known_as_long_as_it_lives() -> None:
    sleeping = subprocess.Popen(["sleep", "60"])
    assert int(start_of(sleeping.pid)) >= int(OWN_START) > 0
    sleeping.kill()
    sleeping.wait()
    assert start_of(sleeping.pid) == ""


class Told(BaseException):
    """Exception of the handler under test."""


@pytest.fixture
def handler(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[int, FrameType | None], None]]:
    """Handle SIGUSR1 by raising, and remind soon."""

    def tell(number: int, frame: FrameType | None) -> None:
        raise Told

    monkeypatch.setattr(processes, "REMINDER_S", 0.05)
    before = signal.signal(signal.SIGUSR1, tell)
    yield tell
    signal.signal(signal.SIGUSR1, before)


def test_a_signal_whose_exception_was_swallowed_is_sent_again(handler: Callable[..., None]) -> None:
    began = time.monotonic()
    with pytest.raises(Told), repeated(signal.SIGUSR1):
        with pytest.raises(Told):  # stands for a finalizer, which swallows what it raises
            os.kill(os.getpid(), signal.SIGUSR1)
            time.sleep(60)
        time.sleep(60)
    assert time.monotonic() - began < 30
    assert signal.getsignal(signal.SIGUSR1) is handler


def test_a_signal_that_was_heard_is_not_sent_again(handler: Callable[..., None]) -> None:
    with pytest.raises(Told), repeated(signal.SIGUSR1):
        os.kill(os.getpid(), signal.SIGUSR1)
        time.sleep(10)
    time.sleep(0.3)


def test_a_signal_without_a_handler_keeps_its_default() -> None:
    before = signal.signal(signal.SIGUSR1, signal.SIG_DFL)
    with repeated(signal.SIGUSR1):
        assert signal.getsignal(signal.SIGUSR1) is signal.SIG_DFL
    signal.signal(signal.SIGUSR1, before)


@pytest.fixture
def nfs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder where a shared lock takes a descriptor that can read, an exclusive one a descriptor that can write."""
    flock = fcntl.flock
    wrong = {fcntl.LOCK_SH: os.O_WRONLY, fcntl.LOCK_EX: os.O_RDONLY}

    def checked(file: int | IO[str], operation: int) -> None:
        mode = fcntl.fcntl(file, fcntl.F_GETFL) & os.O_ACCMODE
        if wrong.get(operation & ~fcntl.LOCK_NB) == mode:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        flock(file, operation)

    monkeypatch.setattr(fcntl, "flock", checked)
    return tmp_path


def test_a_lock_is_taken_on_nfs(nfs: Path) -> None:
    (nfs / "kept").write_text("kept")
    for name in ("new", "kept"):
        with locked(nfs / name, shared=True) as first, locked(nfs / name, shared=True) as second:
            assert first and second
            with locked(nfs / name) as alone:
                assert not alone
        with locked(nfs / name) as alone, locked(nfs / name, shared=True) as first:
            assert alone and not first
    assert (nfs / "kept").read_text() == "kept"


def test_a_queue_and_a_slot_work_on_nfs(nfs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_SLOTS", str(nfs / "slots"))
    (nfs / "slots" / "queue-cpu").mkdir(parents=True)
    (nfs / "slots" / "queue-cpu" / "0-0.ticket").write_text("left by a process that was killed")
    with resources.slot("cpu", lambda _: None) as waited_s:
        assert waited_s < 5


def test_a_server_is_in_use_on_nfs(nfs: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "spawn_guard", lambda *_: None)
    started = server.Server(nfs / "server", nfs / "prefect")
    started.start()
    assert started.is_used()
    started.release()
