"""Processes are told apart, also those of containers that have the name of their host; lost signals come again."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from types import FrameType

import pytest

from flows import processes
from flows.processes import OWN_START, host_id, repeated, start_of

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
