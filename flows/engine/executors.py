"""How a step runs: in a process of its own, in a container, or in this process. `$DG4D_EXECUTOR` chooses by name.

An executor is a function `(spec, request, on_progress) -> StepResult` that raises one of the errors below.
"""

import fcntl
import json
import os
import signal
import subprocess
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from pydantic import ValidationError

from dg4d_lib.errors import BackendUnavailable
from flows.engine import forks, resources
from flows.engine.containers import container
from flows.home import store
from flows.processes import locked, without_prefect
from flows.step_errors import (
    StepBadInput,
    StepCrashed,
    StepDiverged,
    StepError,
    StepLost,
    StepMissing,
    StepOutOfMemory,
    StepTimedOut,
    StepUnreachable,
)
from steps.contract import (
    EXIT_BAD_INPUT,
    EXIT_DIVERGED,
    EXIT_MISSING,
    EXIT_OUT_OF_MEMORY,
    StepFailure,
    StepRequest,
    StepResult,
    StepSpec,
)
from steps.runtime.job import Progress
from steps.runtime.messages import notes_to
from steps.runtime.perform import perform
from steps.store.files import home, remove_tree

Say = Callable[[str], None]
Execute = Callable[[StepSpec, StepRequest, Progress, Say], StepResult]

TAIL_BYTES = 4000  # of standard error, for the message of a crash
IN_USE = "in-use"  # the locked file of a scratch folder
KILL_GRACE_S = 5.0  # between asking a step to end and ending it


_ERRORS: dict[str, type[StepError]] = {
    "bad_input": StepBadInput,
    "missing": StepMissing,
    "lost": StepLost,
    "unreachable": StepUnreachable,
    "diverged": StepDiverged,
    "out_of_memory": StepOutOfMemory,
    "crashed": StepCrashed,
}
_ERRORS_BY_STATUS: dict[int, type[StepError]] = {
    EXIT_BAD_INPUT: StepBadInput,
    EXIT_MISSING: StepMissing,
    EXIT_DIVERGED: StepDiverged,
    EXIT_OUT_OF_MEMORY: StepOutOfMemory,
}
KILLED = (  # nobody else kills a step without a word
    "it was killed, most likely because memory ran out: end other programs, or choose smaller settings"
)


def in_process(spec: StepSpec, request: StepRequest, on_progress: Progress, say: Say = lambda text: None) -> StepResult:
    """Run a step here; for tests and debuggers. Neither its time nor its memory is bounded."""
    with notes_to(say):
        outcome, error = perform(request, store(), on_progress)
    if isinstance(outcome, StepFailure):
        raise _ERRORS[outcome.kind](spec.name, outcome.message, outcome.pictures) from error
    return outcome


def in_subprocess(
    spec: StepSpec, request: StepRequest, on_progress: Progress, say: Say = lambda text: None
) -> StepResult:
    """Run a step in a process of its own, which ends with this one and is killed after `spec.timeout_s`."""
    with _scratch() as folder:

        def start(stderr: BinaryIO) -> forks.Fork:
            environment = {"TMPDIR": str(folder), **resources.environment()}
            begun = forks.fork(_arguments(folder), environment, stderr, resources.handles())
            if begun is None:
                raise StepCrashed(
                    spec.name, "the fork server exited twice; run `python -m steps.runtime.fork_server 0` to see why"
                )
            return begun

        return _result_of(_Program(start, end=lambda: None), folder, spec, request, on_progress, say)


def in_container(
    spec: StepSpec, request: StepRequest, on_progress: Progress, say: Say = lambda text: None
) -> StepResult:
    """Run a step in a container of its own, which ends with this process and is removed after `spec.timeout_s`."""
    with _scratch() as folder:
        try:
            run = container(request, folder, store().address)
        except BackendUnavailable as error:
            raise StepMissing(spec.name, str(error)) from error

        def start(stderr: BinaryIO) -> subprocess.Popen[str]:
            return subprocess.Popen(
                [*run.command, *_arguments(folder), "--parent", "-"],
                stdin=subprocess.PIPE,  # open for as long as this process lives
                stdout=subprocess.PIPE,
                stderr=stderr,
                env={**without_prefect(), **resources.environment()},  # an engine may hand on what it has
                pass_fds=resources.handles(),
                start_new_session=True,
                text=True,
            )

        return _result_of(_Program(start, end=run.remove), folder, spec, request, on_progress, say)


Process = forks.Fork | subprocess.Popen[str]


@dataclass(frozen=True)
class _Program:
    """What runs a step outside of this process: what starts it, told its standard error, and what ends the rest."""

    start: Callable[[BinaryIO], Process]
    end: Callable[[], None]


def _result_of(
    program: _Program, folder: Path, spec: StepSpec, request: StepRequest, on_progress: Progress, say: Say
) -> StepResult:
    """Run a program that reads the request and writes the result in a folder; its result, or the error it means."""
    (folder / "request.json").write_text(request.model_dump_json(), encoding="utf-8")
    with (folder / "stderr").open("wb") as stderr:
        process = program.start(stderr)
    status, timed_out = _watched(process, program.end, spec.timeout_s, on_progress, say)
    if timed_out:
        raise StepTimedOut(spec.name, f"no result after {spec.timeout_s:g} s, so it was stopped")
    outcome = _outcome(folder / "result.json")
    if status == 0 and isinstance(outcome, StepResult):
        return outcome
    if isinstance(outcome, StepFailure):
        raise _ERRORS[outcome.kind](spec.name, outcome.message, outcome.pictures)
    if status in (-signal.SIGKILL, EXIT_OUT_OF_MEMORY):
        raise StepOutOfMemory(spec.name, KILLED)
    tail = _tail(folder / "stderr")
    if status in _ERRORS_BY_STATUS:
        raise _ERRORS_BY_STATUS[status](spec.name, tail or f"the process ended with status {status}")
    reason = f"killed by signal {-status}" if status < 0 else f"ended with status {status}"
    raise StepCrashed(spec.name, f"{reason} and no result" + (f": {tail}" if tail else ""))


EXECUTORS: dict[str, Execute] = {"subprocess": in_subprocess, "container": in_container, "in_process": in_process}


def configured_executor() -> Execute:
    """The executor that `$DG4D_EXECUTOR` names; `subprocess` without it.

    Raises:
        StepMissing: there is none of that name.
    """
    name = os.environ.get("DG4D_EXECUTOR", "subprocess")
    if name not in EXECUTORS:
        raise StepMissing("executor", f"$DG4D_EXECUTOR is {name!r}; choose one of: {', '.join(EXECUTORS)}")
    return EXECUTORS[name]


def prepare() -> None:
    """Begin what the first step would wait for; for who is about to run one."""
    if configured_executor() is in_subprocess:
        forks.prepare()


_running: dict[Process, Callable[[], None]] = {}


def stop_all() -> None:
    """End every step that runs for this process, at once, and begin no other; their callers get an error."""
    resources.stopping.set()
    for process, end in tuple(_running.items()):
        _stop(process, end)


def _arguments(folder: Path) -> list[str]:
    """What `steps.main` is told."""
    return [str(folder / "request.json"), str(folder / "result.json"), "--store", store().address]


def _watched(
    process: Process, end: Callable[[], None], timeout_s: float, on_progress: Progress, say: Say
) -> tuple[int, bool]:
    """Follow a step to its end: its exit status, and whether it was stopped for its time."""
    timed_out = threading.Event()

    def stop() -> None:
        timed_out.set()
        _stop(process, end)

    alarm = threading.Timer(timeout_s, stop)
    alarm.daemon = True
    alarm.start()
    _running[process] = end
    try:
        assert process.stdout is not None  # it is a pipe
        for line in process.stdout:
            _relay(line, on_progress, say)
        status = process.wait()
        return status, timed_out.is_set()
    finally:
        alarm.cancel()
        _running.pop(process, None)
        _stop(process, end)
        process.wait(KILL_GRACE_S)
        for pipe in filter(None, (process.stdin, process.stdout)):
            pipe.close()


def _relay(line: str, on_progress: Progress, say: Say) -> None:
    try:
        report = json.loads(line)
        if "note" in report:
            say(str(report["note"]))
            return
        done, total, values = int(report["done"]), int(report["total"]), dict(report["values"])
    except (ValueError, KeyError, TypeError):
        return
    on_progress(done, total, values)


def _stop(process: Process, end: Callable[[], None]) -> None:
    """Kill a program, with every process that it started here, and what it started elsewhere."""
    if process.poll() is None:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        end()


def _outcome(path: Path) -> StepResult | StepFailure | None:
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    for kind in (StepResult, StepFailure):
        with suppress(ValidationError):
            return kind.model_validate_json(text)
    return None


def _tail(path: Path) -> str:
    content = path.read_bytes()[-TAIL_BYTES:].decode(errors="replace").strip()
    return "\n".join(content.splitlines()[-12:])


@contextmanager
def _scratch() -> Iterator[Path]:
    """A folder for one step; it also removes those of commands that were killed.

    Who uses a folder holds the lock of a file in it: commands in several containers may share them, and none of these
    sees the processes of another.
    """
    scratch = home() / "scratch"
    scratch.mkdir(parents=True, exist_ok=True)
    with (scratch.parent / "scratch.lock").open("a") as one_look:
        fcntl.flock(one_look, fcntl.LOCK_EX)  # a folder without a lock is one that was left
        for old in scratch.iterdir():
            with suppress(FileNotFoundError), locked(old / IN_USE) as left:  # it may go at this moment
                if left:
                    remove_tree(old)
        folder = Path(tempfile.mkdtemp(dir=scratch))
        in_use = (folder / IN_USE).open("a")
        fcntl.flock(in_use, fcntl.LOCK_EX)
    with in_use:
        try:
            yield folder
        finally:
            remove_tree(folder)
