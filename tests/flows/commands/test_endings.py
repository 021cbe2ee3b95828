"""Signals during a command: lost ones come again, and cleanup is left in peace."""

import os
import signal
import time
from collections.abc import Iterator

import pytest
import typer

from flows.commands import endings
from flows.exit_status import EXIT_HANGUP, EXIT_TERMINATED


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(endings, "REMINDER_S", 0.05)
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
            time.sleep(10)
        time.sleep(10)
    assert time.monotonic() - began < 5
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
