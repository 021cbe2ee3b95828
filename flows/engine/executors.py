"""Executors of steps: child process, container, or this process, as `$DG4D_EXECUTOR` names them.

An executor is a function `(spec, request, on_progress, say) -> StepResult` that raises a `StepError`.
"""

import base64
import fcntl
import json
import os
import signal
import subprocess
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Protocol

from pydantic import TypeAdapter, ValidationError

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
    EXIT_OUT_OF_MEMORY,
    EXIT_STATUS,
    StepFailure,
    StepRequest,
    StepResult,
    StepSpec,
)
from steps.runtime.failures import MEMORY_SETTINGS
from steps.runtime.job import Progress
from steps.runtime.messages import notes_to
from steps.runtime.perform import perform
from steps.store.files import home, remove_tree

Say = Callable[[str], None]
Show = Callable[[bytes], None]


def no_picture(_: bytes) -> None:
    """Discard a picture of the work so far."""


class Execute(Protocol):
    """Run a step; raise a `StepError` if it does not finish."""

    def __call__(
        self, spec: StepSpec, request: StepRequest, on_progress: Progress, say: Say, on_picture: Show = no_picture
    ) -> StepResult:
        """Run it.

        Args:
            spec: of the step.
            request: of the step.
            on_progress: called with every progress message.
            say: called with every note.
            on_picture: called with pictures of the work so far, PNG.
        """


TAIL_BYTES = 4000  # of standard error, for the message of a crash
IN_USE = "in-use"  # locked file of a scratch folder
OUTCOME: TypeAdapter[StepResult | StepFailure] = TypeAdapter(StepResult | StepFailure)
KILL_GRACE_S = 5.0  # wait for a killed process to be reaped


_ERRORS: dict[str, type[StepError]] = {  # by the kind of a `StepFailure`
    "bad_input": StepBadInput,
    "missing": StepMissing,
    "lost": StepLost,
    "unreachable": StepUnreachable,
    "diverged": StepDiverged,
    "out_of_memory": StepOutOfMemory,
    "crashed": StepCrashed,
}
KILLED = (  # SIGKILL without a failure report is nearly always the kernel's out-of-memory killer
    f"the step was killed, probably out of memory: end other programs, or lower {MEMORY_SETTINGS}"
)


def in_process(
    spec: StepSpec, request: StepRequest, on_progress: Progress, say: Say, on_picture: Show = no_picture
) -> StepResult:
    """Run a step in this process, without limits of time and memory; for tests and debuggers."""
    with notes_to(say):
        outcome, error = perform(request, store(), on_progress)
    if isinstance(outcome, StepFailure):
        raise _ERRORS[outcome.kind](spec.name, outcome.message, outcome.pictures) from error
    return outcome


def in_subprocess(
    spec: StepSpec, request: StepRequest, on_progress: Progress, say: Say, on_picture: Show = no_picture
) -> StepResult:
    """Run a step in a child process, which ends with this process and is killed after `spec.timeout_s`."""
    with _scratch(request) as folder:
        environment = {"TMPDIR": str(folder), **resources.environment()}
        with (folder / "stderr").open("wb") as stderr:
            process = forks.fork(_arguments(folder), environment, stderr, resources.handles())
        if process is None:
            raise StepCrashed(
                spec.name, "the fork server exited twice; run `python -m steps.runtime.fork_server 0` to see why"
            )
        return _result_of(process, lambda: None, folder, spec, on_progress, say, on_picture)


def in_container(
    spec: StepSpec, request: StepRequest, on_progress: Progress, say: Say, on_picture: Show = no_picture
) -> StepResult:
    """Run a step in a container, which ends with this process and is removed after `spec.timeout_s`."""
    with _scratch(request) as folder:
        try:
            run = container(request, folder, store().address)
        except BackendUnavailable as error:
            raise StepMissing(spec.name, str(error)) from error
        with (folder / "stderr").open("wb") as stderr:
            process = subprocess.Popen(
                [*run.command, *_arguments(folder), "--parent", "-"],
                stdin=subprocess.PIPE,  # the step ends when it is closed, which it is when this process ends
                stdout=subprocess.PIPE,
                stderr=stderr,
                env={**without_prefect(), **resources.environment()},  # an engine may pass its own environment on
                pass_fds=resources.handles(),
                start_new_session=True,
                text=True,
            )
        return _result_of(process, run.remove, folder, spec, on_progress, say, on_picture)


Process = forks.Fork | subprocess.Popen[str]


def _result_of(
    process: Process,
    remove: Callable[[], None],
    folder: Path,
    spec: StepSpec,
    on_progress: Progress,
    say: Say,
    on_picture: Show,
) -> StepResult:
    """Follow a process to its end and return the result that it wrote into a folder, or raise its error.

    Args:
        process: of the step.
        remove: called when the process is killed, to end the processes that it started elsewhere.
        folder: with `result.json` and `stderr` of the step.
        spec: of the step.
        on_progress: called with every progress message.
        say: called with every note.
        on_picture: called with every picture.
    """
    status, timed_out = _watched(
        process, remove, spec.timeout_s, lambda line: _relay(line, on_progress, say, on_picture)
    )
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
    kind = next((kind for kind, code in EXIT_STATUS.items() if code == status), "crashed")
    if kind != "crashed":
        raise _ERRORS[kind](spec.name, tail or f"the process exited with status {status}")
    reason = f"killed by signal {-status}" if status < 0 else f"exited with status {status}"
    raise StepCrashed(spec.name, f"{reason} without writing a result" + (f": {tail}" if tail else ""))


EXECUTORS: dict[str, Execute] = {"subprocess": in_subprocess, "container": in_container, "in_process": in_process}


def configured_executor() -> Execute:
    """Return the executor that `$DG4D_EXECUTOR` names, by default `subprocess`.

    Raises:
        StepMissing: the name is unknown.
    """
    name = os.environ.get("DG4D_EXECUTOR", "subprocess")
    if name not in EXECUTORS:
        raise StepMissing("executor", f"$DG4D_EXECUTOR is {name!r}; choose one of: {', '.join(EXECUTORS)}")
    return EXECUTORS[name]


def prepare() -> None:
    """Start the fork server early, so that the first step does not wait for its imports."""
    if configured_executor() is in_subprocess:
        forks.prepare()


_running: dict[Process, Callable[[], None]] = {}


def stop_all() -> None:
    """Kill every step of this process and start no other; the callers of the steps get an error."""
    resources.stopping.set()
    for process, end in tuple(_running.items()):
        _stop(process, end)


def _arguments(folder: Path) -> list[str]:
    """Return the arguments of `steps.main`."""
    return [str(folder / "request.json"), str(folder / "result.json"), "--store", store().address]


def _watched(
    process: Process, end: Callable[[], None], timeout_s: float, relay: Callable[[str], None]
) -> tuple[int, bool]:
    """Return the exit status of a step, and true if it was killed after `timeout_s`."""
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
            relay(line)
        status = process.wait()
        return status, timed_out.is_set()
    finally:
        alarm.cancel()
        _running.pop(process, None)
        _stop(process, end)
        process.wait(KILL_GRACE_S)
        for pipe in filter(None, (process.stdin, process.stdout)):
            pipe.close()


def _relay(line: str, on_progress: Progress, say: Say, on_picture: Show) -> None:
    try:
        report = json.loads(line)
        if "picture" in report:
            on_picture(base64.b64decode(report["picture"], validate=True))
            return
        if "note" in report:
            say(str(report["note"]))
            return
        done, total, values = int(report["done"]), int(report["total"]), dict(report["values"])
    except (ValueError, KeyError, TypeError):
        return
    on_progress(done, total, values)


def _stop(process: Process, end: Callable[[], None]) -> None:
    """Kill the process group of a step, and the processes that it started elsewhere."""
    if process.poll() is None:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        end()


def _outcome(path: Path) -> StepResult | StepFailure | None:
    """Return the result or failure that the step wrote; None if there is none, or it is unreadable."""
    with suppress(FileNotFoundError, ValidationError):
        return OUTCOME.validate_json(path.read_bytes())
    return None


def _tail(path: Path) -> str:
    content = path.read_bytes()[-TAIL_BYTES:].decode(errors="replace").strip()
    return "\n".join(content.splitlines()[-12:])


@contextmanager
def _scratch(request: StepRequest) -> Iterator[Path]:
    """Yield a scratch folder with the request of a step; remove folders that killed commands left behind.

    A folder in use has a locked file: containers may share the parent folder and do not see each other's processes.
    """
    scratch = home() / "scratch"
    scratch.mkdir(parents=True, exist_ok=True)
    with (scratch.parent / "scratch.lock").open("a") as mutex:
        fcntl.flock(mutex, fcntl.LOCK_EX)  # between the creation of a folder and its lock
        for old in scratch.iterdir():
            with suppress(FileNotFoundError), locked(old / IN_USE) as unused:  # another command may remove it meanwhile
                if unused:
                    remove_tree(old)
        folder = Path(tempfile.mkdtemp(dir=scratch))
        in_use = (folder / IN_USE).open("a")
        fcntl.flock(in_use, fcntl.LOCK_EX)
    with in_use:
        try:
            (folder / "request.json").write_text(request.model_dump_json(), encoding="utf-8")
            yield folder
        finally:
            remove_tree(folder)
