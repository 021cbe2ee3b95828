"""End of a command: every error and every signal becomes one message and an exit status."""

import errno
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import NoReturn

import typer

EXIT_FAILED = 1
EXIT_BAD_INPUT = 65
EXIT_MISSING = 69
EXIT_HANGUP, EXIT_INTERRUPTED, EXIT_TERMINATED = 129, 130, 143  # 128 and the number of the signal, as shells have it
UNREACHABLE = {errno.EACCES, errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR, errno.EISDIR}  # of paths that were given
CODES = {signal.SIGHUP: EXIT_HANGUP, signal.SIGTERM: EXIT_TERMINATED}
STOPPED = "stopped; the same command goes on after the last finished step"


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP arrived; it ends a command as Ctrl-C does.

    Args:
        number: of the signal.
    """

    def __init__(self, number: signal.Signals) -> None:
        super().__init__(number.name)
        self.number = number


@contextmanager
def clear_ending() -> Iterator[None]:
    """Turn every error into one message and an exit status, and SIGTERM and SIGHUP into what Ctrl-C is."""
    with _signals() as received:
        try:
            yield
        except (typer.Exit, typer.Abort, typer.BadParameter):
            raise
        except KeyboardInterrupt as error:
            _stop_steps()
            _end(STOPPED, CODES[error.number] if isinstance(error, Terminated) else EXIT_INTERRUPTED)
        except Exception as error:
            if received:  # a terminal that is gone cannot be written to, for example
                _stop_steps()
                _end(STOPPED, CODES[received[0]])
            _end(*_verdict(error))


@contextmanager
def _signals() -> Iterator[list[signal.Signals]]:
    """Raise `Terminated` for the first SIGTERM or SIGHUP while the block runs; gives the signals that arrived.

    A signal that the parent has ignored, as `nohup` does with SIGHUP, stays ignored.
    """
    received: list[signal.Signals] = []

    def stop(number: int, frame: FrameType | None) -> None:
        received.append(signal.Signals(number))
        if len(received) == 1:  # cleaning up is not interrupted
            raise Terminated(received[0])

    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in CODES:
            if signal.getsignal(number) is signal.SIG_DFL:
                before[number] = signal.signal(number, stop)
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _verdict(error: Exception) -> tuple[str, int]:
    from dg4d_lib.errors import BackendUnavailable, BadInput, FitDiverged
    from flows.engine.executors import StepBadInput, StepDiverged, StepError, StepMissing
    from flows.serving.server import ServerUnavailable
    from steps.store.artifact_store import ArtifactMissing
    from steps.store.files import NO_SPACE

    text = error.message if isinstance(error, StepError) else str(error)
    match error:
        case BadInput() | FitDiverged() | StepBadInput():
            return text, EXIT_BAD_INPUT
        case StepDiverged():
            return str(error), EXIT_BAD_INPUT
        case BackendUnavailable() | StepMissing() | ServerUnavailable() | ArtifactMissing():
            return text, EXIT_MISSING
        case StepError():
            return str(error), EXIT_FAILED
        case OSError() if error.errno in {*NO_SPACE, errno.EROFS, *UNREACHABLE}:
            advice = "choose another place" if error.errno in UNREACHABLE else "free some space and try again"
            return f"{error.strerror}: {error.filename or 'the disk'}; {advice}", EXIT_BAD_INPUT
    return f"something broke ({type(error).__name__}: {error}); details: {_saved_traceback(error)}", EXIT_FAILED


def _saved_traceback(error: Exception) -> str:
    from steps.store.files import home

    path = home() / "last-error.txt"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(traceback.format_exception(error)), encoding="utf-8")
    except OSError:
        return "could not be written"
    return str(path)


def _stop_steps() -> None:
    if "flows.engine.executors" in sys.modules:
        from flows.engine.executors import stop_all

        stop_all()


def _end(message: str, status: int) -> NoReturn:
    from flows.ui.escaping import visible

    with suppress(OSError):  # nobody may be there to read it
        typer.echo(f"dg4d: {visible(message)}", err=True)
    raise typer.Exit(status)
