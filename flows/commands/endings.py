"""How a command ends: every error becomes one message and an exit status."""

import errno
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

import typer

EXIT_FAILED = 1
EXIT_BAD_INPUT = 65
EXIT_MISSING = 69
EXIT_INTERRUPTED = 130


@contextmanager
def clear_ending() -> Iterator[None]:
    """Turn every error into one message and an exit status."""
    try:
        yield
    except (typer.Exit, typer.Abort, typer.BadParameter):
        raise
    except KeyboardInterrupt:
        _stop_steps()
        _end("stopped; the same command goes on after the last finished step", EXIT_INTERRUPTED)
    except Exception as error:
        _end(*_verdict(error))


def _verdict(error: Exception) -> tuple[str, int]:
    from dg4d_lib.errors import BackendUnavailable, BadInput, FitDiverged
    from flows.engine.executors import StepBadInput, StepDiverged, StepError, StepMissing
    from flows.serving.server import ServerUnavailable
    from steps.store import NO_SPACE, ArtifactMissing

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
        case OSError() if error.errno in NO_SPACE or error.errno == errno.EROFS:
            return f"{error.strerror}: {error.filename or 'the disk'}; free some space and try again", EXIT_BAD_INPUT
    return f"something broke ({type(error).__name__}: {error}); details: {_saved_traceback(error)}", EXIT_FAILED


def _saved_traceback(error: Exception) -> str:
    from steps.store import home

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
    typer.echo(f"dg4d: {message}", err=True)
    raise typer.Exit(status)
