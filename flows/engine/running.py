"""Execution of a step in its slot with the configured executor; independent of the recording of runs."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Protocol, TypeVar

from flows import home
from flows.engine import resources
from flows.engine.events import StepEvent, emit
from flows.engine.executors import configured_executor
from flows.engine.leases import hold
from flows.engine.remarks import remark
from flows.engine.requests import label_of, request_for
from flows.packages.flow_result import StepRun
from flows.step_errors import StepCrashed, StepError, StepOutOfMemory, StepUnreachable
from steps.contract import StepResult
from steps.runtime.installed_code import catalog
from steps.store.artifact_store import StoreUnreachable

RETRIES = 2
RETRY_DELAY_S = 2.0  # doubled with each retry

Result = TypeVar("Result", bound=StepResult)


class StepObserver(Protocol):
    """Record of one run of a step, beside its events."""

    def on_slot(self, waited_s: float) -> None:
        """Note the seconds that the step waited for its slot."""

    def on_progress(self, label: str, item: str, done: int, total: int, values: dict[str, float]) -> None:
        """Note the progress of the step."""

    def on_picture(self, label: str, item: str, picture: bytes) -> None:
        """Note a picture of the work so far, PNG."""

    def on_failure(self, label: str, item: str, error: StepError) -> None:
        """Note the failure of the step."""

    def on_result(self, label: str, item: str, result: StepResult) -> None:
        """Note the result of the step."""


class NullObserver:
    """Observer that records only the time spent waiting for a slot."""

    def __init__(self) -> None:
        self.waited_s = 0.0

    def on_slot(self, waited_s: float) -> None:
        """Keep the waiting time."""
        self.waited_s = waited_s

    def on_progress(self, label: str, item: str, done: int, total: int, values: dict[str, float]) -> None:
        """Do nothing."""

    def on_picture(self, label: str, item: str, picture: bytes) -> None:
        """Do nothing."""

    def on_failure(self, label: str, item: str, error: StepError) -> None:
        """Do nothing."""

    def on_result(self, label: str, item: str, result: StepResult) -> None:
        """Do nothing."""


@contextmanager
def observed_by(observer: StepObserver) -> Iterator[None]:
    """Have an observer record the step that runs in the block, in this thread."""
    token = _observer.set(observer)
    try:
        yield
    finally:
        _observer.reset(token)


def run_step(step: str, result_type: type[Result], **arguments: Any) -> Result:
    """Run a step in its slot, emit its events, and notify the observer of this thread.

    Args:
        step: name in the catalog.
        result_type: class of the result.
        arguments: arguments of the call by name; see `request_for`.

    Raises:
        StepError: the step did not finish.
    """
    request, conversion = request_for(step, arguments), arguments["conversion"]
    item, label = conversion.item, label_of(step, arguments)
    observer = _observer.get() or NullObserver()
    emit(StepEvent(item, label, "started"))

    def on_progress(done: int, total: int, values: dict[str, float]) -> None:
        emit(StepEvent(item, label, "progress", done=done, total=total, values=values))
        observer.on_progress(label, item, done, total, values)

    def say(text: str) -> None:
        emit(StepEvent(item, label, "note", text=text))

    def show(picture: bytes) -> None:
        observer.on_picture(label, item, picture)

    try:
        turn = resources.Turn(conversion.begun_ns, f"{label} of {item}")
        with resources.slot(resources.resource_of(request), say, turn) as waited_s:
            observer.on_slot(waited_s)
            result = configured_executor()(catalog()[step], request, on_progress, say, show)
    except StepError as error:
        observer.on_failure(label, item, error)
        raise
    observer.on_result(label, item, result)
    return result_type.model_validate(result.model_dump())


def may_succeed(error: BaseException | None, attempts: int) -> bool:
    """Return true if a failed step may succeed now: memory or the store may be available, a crash gets one retry.

    A step that the user stopped is not retried.
    """
    if resources.stopping.is_set():
        return False
    if isinstance(error, StepOutOfMemory | StepUnreachable | StoreUnreachable):
        return True
    return isinstance(error, StepCrashed | OSError) and attempts <= 1


def finish_step(item: str, label: str, result: StepResult, cached: bool, seconds: float, waited_s: float) -> StepRun:
    """Return the record of a finished step, protect a cached result from garbage collection, and emit the events."""
    if cached:
        hold(home.store(), item, (ref.digest for ref in result.outputs.values()))
    remark(item, label, result)
    emit(StepEvent(item, label, "finished", seconds=seconds, waited_s=waited_s, cached=cached))
    return StepRun(label=label, cached=cached, wall_s=round(seconds, 3), waited_s=round(waited_s, 3), result=result)


def fail_step(item: str, label: str, seconds: float, interrupted: bool = False) -> None:
    """Emit the event of a step that did not finish; one that the user stopped is not called failed."""
    if interrupted or resources.stopping.is_set():
        emit(StepEvent(item, label, "note", text=f"interrupted after {seconds:.1f} s"))
    else:
        emit(StepEvent(item, label, "failed", seconds=seconds))


_observer: ContextVar[StepObserver | None] = ContextVar("observer", default=None)
