"""Conversion of errors and signals to one message and an exit status."""

import errno
import os
import select
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import NoReturn

import typer

from flows.exit_status import (
    EXIT_BAD_INPUT,
    EXIT_FAILED,
    EXIT_HANGUP,
    EXIT_INTERRUPTED,
    EXIT_MISSING,
    EXIT_PIPE,
    EXIT_TERMINATED,
)
from flows.processes import start_reminder

__all__ = ["EXIT_BAD_INPUT", "EXIT_FAILED", "Terminated", "exit_on_error"]

UNREACHABLE = {errno.EACCES, errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR, errno.EISDIR}  # errors of given paths
# errors of mkdir if a file is in the way or the folder cannot exist
NO_FOLDER = {errno.EEXIST, errno.ENOENT, errno.ENOTDIR}
CODES = {signal.SIGHUP: EXIT_HANGUP, signal.SIGTERM: EXIT_TERMINATED}
STOPPED = "stopped; run the same command again to continue after the last finished step"


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP, handled like Ctrl-C.

    Args:
        number: of the signal.
    """

    def __init__(self, number: signal.Signals) -> None:
        super().__init__(number.name)
        self.number = number


@contextmanager
def exit_on_error(stopped: str = STOPPED) -> Iterator[None]:
    """Exit with one message and a status on any error; treat SIGTERM and SIGHUP like Ctrl-C.

    Args:
        stopped: message after Ctrl-C or a signal.
    """
    with _signals() as received:
        try:
            yield
        except (typer.Exit, typer.Abort, typer.BadParameter):
            raise
        except KeyboardInterrupt as error:
            _stop_steps()
            _end(stopped, CODES[error.number] if isinstance(error, Terminated) else EXIT_INTERRUPTED)
        except Exception as error:
            if received:  # the error may be a consequence, such as a write to a closed terminal
                _stop_steps()
                _end(stopped, CODES[received[0]])
            if isinstance(error, BrokenPipeError) and _output_closed():
                raise typer.Exit(EXIT_PIPE) from None  # as `dg4d settings | head`
            _end(*describe(error))


@contextmanager
def _signals() -> Iterator[list[signal.Signals]]:
    """Raise `Terminated` for the first SIGTERM or SIGHUP, again if it was lost; yield the received signals.

    A signal that the parent ignores, as `nohup` does with SIGHUP, stays ignored.
    """
    received: list[signal.Signals] = []
    ended = threading.Event()
    restoring = threading.Lock()  # no reminder after the default handlers are back: they would end the process

    def stop(number: int, frame: FrameType | None) -> None:
        received.append(signal.Signals(number))
        if len(received) == 1:
            start_reminder(received[0], ended, restoring)
        if not ended.is_set() and not _is_unwinding():  # later signals must not interrupt the cleanup
            raise Terminated(received[0])

    before = {}
    if threading.current_thread() is threading.main_thread():
        for number in CODES:
            if signal.getsignal(number) is signal.SIG_DFL:
                before[number] = signal.signal(number, stop)
    try:
        yield received
    finally:
        with restoring:
            ended.set()
        for number, handler in before.items():
            signal.signal(number, handler)


def _is_unwinding() -> bool:
    """Return whether the interrupted code cleans up after `Terminated`."""
    error = sys.exception()
    while error is not None and not isinstance(error, Terminated):
        error = error.__context__
    return error is not None


def describe(error: Exception) -> tuple[str, int]:
    """Return the message and the exit status of an error; save the traceback of an unexpected one."""
    from dg4d_lib.errors import BackendUnavailable, BadInput, FitDiverged
    from flows.serving.server import ServerUnavailable
    from flows.step_errors import StepDiverged, StepError
    from steps.store.artifact_store import ArtifactMissing

    text = error.message if isinstance(error, StepError) else str(error)
    match error:
        case BadInput() | FitDiverged():
            return text, EXIT_BAD_INPUT
        case StepDiverged():
            return str(error), EXIT_BAD_INPUT
        case BackendUnavailable() | ServerUnavailable() | ArtifactMissing():
            return text, EXIT_MISSING
        case StepError():
            return str(error), EXIT_FAILED
        case OSError() if sentence := _unusable_folder(error) or _refused_path(error):
            return sentence, EXIT_BAD_INPUT
    return f"internal error ({type(error).__name__}: {error}); traceback: {_save_traceback(error)}", EXIT_FAILED


def _unusable_folder(error: OSError) -> str:
    """Return a sentence if the folder of an environment variable is a file or cannot be created, else nothing."""
    variable = _variable_of(str(error.filename)) if error.errno in NO_FOLDER else ""
    folder = _folders().get(variable)
    if folder is None or folder.is_dir():
        return ""
    state = "is not a folder" if folder.exists() else f"cannot be created ({error.strerror})"
    return f"${variable} {state}: {folder}; name a folder that can be written to"


def _refused_path(error: OSError) -> str:
    """Return a sentence if the error is due to a path or a disk that the user can change, else nothing."""
    from steps.store.files import NO_SPACE

    if error.errno not in {*NO_SPACE, errno.EROFS, *UNREACHABLE}:
        return ""
    advice = "free some space and try again" if error.errno in NO_SPACE else "choose another path"
    if error.errno == errno.EROFS and (variable := _variable_of(str(error.filename))):
        advice = f"name a writable folder in ${variable}"
    return f"{error.strerror}: {error.filename or 'the disk'}; {advice}"


def _folders() -> dict[str, Path]:
    """Return the folders that environment variables name, and the home folder, by variable."""
    from steps.store.files import FOLDER_VARIABLES, home

    given = {name: Path(folder) for name in FOLDER_VARIABLES if (folder := os.environ.get(name))}
    return {"DG4D_HOME": home()} | given


def _variable_of(path: str) -> str:
    """Return the environment variable that names the folder of a path; empty if none does."""
    from steps.store.files import home

    holding = {name: len(folder.parts) for name, folder in _folders().items() if Path(path).is_relative_to(folder)}
    to_create = "DG4D_HOME" if home().is_relative_to(path) else ""
    return max(holding, key=holding.__getitem__, default=to_create)


def _save_traceback(error: Exception) -> str:
    from steps.store.files import home

    path = home() / "last-error.txt"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join(traceback.format_exception(error)), encoding="utf-8")
    except OSError:
        return "could not be written"
    return str(path)


def _output_closed() -> bool:
    """Return whether the reader of standard output is gone; if so, discard buffered output."""
    try:
        number = sys.stdout.fileno()
    except (AttributeError, OSError, ValueError):  # no standard output, or one of a test
        return False
    poll = select.poll()
    poll.register(number, 0)
    closed = any(events & select.POLLERR for _, events in poll.poll(0))
    if closed:
        os.dup2(os.open(os.devnull, os.O_WRONLY), number)
    return closed


def _stop_steps() -> None:
    if "flows.engine.executors" in sys.modules:
        from flows.engine.executors import stop_all

        stop_all()


def _end(message: str, status: int) -> NoReturn:
    from flows.formatting.escaping import visible

    with suppress(OSError):  # the terminal may be closed
        typer.echo(f"dg4d: {visible(message)}", err=True)
    raise typer.Exit(status)
