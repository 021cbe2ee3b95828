"""Endings of a command: exit statuses of errors; lost signals come again, and cleanup is left in peace."""

import errno
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

from dg4d_lib.errors import DG4DError
from flows import processes
from flows.commands import endings
from flows.engine.item_runs import ItemFailed
from flows.exit_status import EXIT_BAD_INPUT, EXIT_FAILED, EXIT_HANGUP, EXIT_STATUS, EXIT_TERMINATED
from flows.home import make_private
from flows.serving.server import ServerUnavailable
from flows.step_errors import StepError
from flows.studio.drafts import TooLarge


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(processes, "REMINDER_S", 0.05)
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # `nohup` ignores it
    yield
    signal.signal(signal.SIGHUP, before)


def ends_with(status: int) -> pytest.RaisesExc[typer.Exit]:
    return pytest.raises(typer.Exit, check=lambda ending: ending.exit_code == status)


def test_a_signal_whose_exception_was_swallowed_is_raised_again() -> None:
    began = time.monotonic()
    with ends_with(EXIT_TERMINATED), endings.exit_on_error():
        with pytest.raises(KeyboardInterrupt):  # stands for a finalizer, which swallows what it raises
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(60)
        time.sleep(60)
    assert time.monotonic() - began < 30
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_reminders_and_further_signals_do_not_interrupt_the_cleanup() -> None:
    cleaned = False
    with ends_with(EXIT_HANGUP), endings.exit_on_error():
        try:
            os.kill(os.getpid(), signal.SIGHUP)
            time.sleep(10)
        finally:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.3)
            cleaned = True
    assert cleaned


def test_an_item_of_several_has_the_exit_status_that_its_error_has_alone() -> None:
    assert TooLarge in of_ours(DG4DError)
    for kind in {*of_ours(DG4DError), ServerUnavailable} - {ItemFailed}:
        error = kind("fit", "why") if issubclass(kind, StepError) else kind.__new__(kind, "why")
        assert endings.describe(error)[1] == EXIT_STATUS.get(kind.__name__, EXIT_FAILED), kind


@pytest.mark.parametrize(
    ("path", "advice"),
    [
        ("/here/home/locks", "name a writable folder in $DG4D_HOME"),
        ("/here", "name a writable folder in $DG4D_HOME"),  # the home folder has to be created
        ("/here/home/store/x", "name a writable folder in $DG4D_STORE"),
        ("/out/x", "choose another path"),
    ],
)
def test_a_read_only_folder_is_told_with_the_variable_that_names_it(
    monkeypatch: pytest.MonkeyPatch, path: str, advice: str
) -> None:
    monkeypatch.setenv("DG4D_HOME", "/here/home")
    monkeypatch.setenv("DG4D_STORE", "/here/home/store")
    error = OSError(errno.EROFS, "Read-only file system", path)
    assert endings.describe(error) == (f"Read-only file system: {path}; {advice}", EXIT_BAD_INPUT)


@pytest.mark.parametrize(
    ("home", "state"),
    [
        ("file", "is not a folder"),
        ("file/below", "cannot be created (Not a directory)"),
        ("/proc/x", "cannot be created"),
    ],
)
def test_a_home_that_is_no_folder_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, home: str, state: str
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / home))
    with pytest.raises(OSError, match="Errno") as raised:
        make_private(tmp_path / home)
    text, status = endings.describe(raised.value)
    assert text.startswith(f"$DG4D_HOME {state}") and f": {tmp_path / home}; name a folder" in text
    assert status == EXIT_BAD_INPUT


def of_ours(kind: type[Exception]) -> set[type[Exception]]:
    """List our subclasses of an exception, at any depth."""
    below = {one for one in kind.__subclasses__() if one.__module__.startswith(("dg4d_lib.", "steps.", "flows."))}
    return below.union(*map(of_ours, below))
