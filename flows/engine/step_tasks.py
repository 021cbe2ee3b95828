"""Prefect tasks of pipeline steps: cache key, retries, progress and artifacts in the UI."""

import functools
import signal
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime
from typing import Any, ParamSpec, TypeVar
from uuid import UUID

import httpx
from prefect import runtime, task
from prefect.artifacts import create_image_artifact, create_progress_artifact, update_progress_artifact
from prefect.client.schemas.objects import State, TaskRun
from prefect.context import FlowRunContext
from prefect.exceptions import TerminationSignal
from prefect.filesystems import LocalFileSystem
from prefect.logging import get_run_logger
from prefect.settings import PREFECT_FLOWS_HEARTBEAT_FREQUENCY, PREFECT_LOCAL_STORAGE_PATH, temporary_settings
from prefect.tasks import Task, exponential_backoff
from prefect.transactions import IsolationLevel, Transaction

from dg4d_lib.errors import DG4DError
from flows import home
from flows.engine.caching import RequestPolicy
from flows.engine.executors import stop_all
from flows.engine.file_locks import FileLocks
from flows.engine.orphans import claim_run
from flows.engine.requests import in_order, label_of, request_for
from flows.engine.running import RETRIES, RETRY_DELAY_S, fail_step, finish_step, may_succeed, observed_by
from flows.formatting.escaping import markdown
from flows.formatting.numbers import format_number
from flows.packages.flow_result import StepRun
from flows.processes import repeated
from flows.step_errors import StepError
from flows.ui import pages
from flows.ui.showing import create_page, revive
from steps.catalog import STEPS
from steps.contract import StepResult

PROGRESS_EVERY_S = 3.0  # between two updates of a progress artifact
CPU, GPU = "resource:cpu", "resource:gpu"  # tags; Prefect keeps a thread and a client for every set of tags

P = ParamSpec("P")
R = TypeVar("R", bound=StepResult)


def step_task(call: Callable[P, R]) -> Task[P, R]:
    """Return the task of a step: cached by its request, retried, tagged with its resource, shown in the UI."""

    @functools.wraps(call)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        with observed_by(_Shown()):
            return call(*args, **kwargs)

    return task(**CACHED, tags=[CPU if STEPS[call.__name__].resource == "cpu" else GPU])(run)


def task_run_name() -> str:
    """Return the name of the current task run: `extract_mesh 1/3: fox`."""
    arguments = runtime.task_run.parameters
    return f"{label_of(runtime.task_run.task_name, arguments)}: {arguments['conversion'].item}"


def should_retry(_task: Task[..., Any], run: TaskRun, state: State[Any]) -> bool:
    """Return true if a failed task run may succeed now; see `may_succeed`."""
    return may_succeed(state.result(raise_on_failure=False), run.run_count)


def note_end(task: Task[..., Any], run: TaskRun, state: State[Any]) -> None:
    """Record the end of a task run, computed, cached or failed, and emit its event."""
    label, _, item = run.name.partition(": ")
    seconds = (datetime.now(UTC) - run.start_time).total_seconds() if run.start_time else 0.0
    waited_s = _waited.pop(str(run.id), 0.0)
    if not state.is_completed():
        fail_step(item, label, seconds)
        return
    result = state.result(raise_on_failure=False)
    assert isinstance(result, StepResult) and run.flow_run_id  # tasks of steps return one, and run in flows
    _finished[run.flow_run_id].append(finish_step(item, label, result, state.name == "Cached", seconds, waited_s))


def finished_steps() -> list[StepRun]:
    """Return the step runs of the current flow run so far, in the order of the catalog, parts by their numbers."""
    return in_order(_finished[UUID(runtime.flow_run.id)])


@contextmanager
def steps_of_flow() -> Iterator[None]:
    """Label the current flow run with its process; kill its steps if the user stops it.

    At the end, the background server is started again if it was killed: Prefect then tries for minutes to set the state
    of the run.
    """
    flow_run = UUID(runtime.flow_run.id)
    try:
        claim_run()
        with repeated(signal.SIGTERM):
            yield
    except (KeyboardInterrupt, TerminationSignal):
        stop_all()  # Prefect waits for tasks in other threads
        raise
    finally:
        revive()
        _finished.pop(flow_run, None)


@contextmanager
def flow_context(settings: Mapping[Any, Any] | None = None) -> Iterator[None]:
    """Keep records of results under `$DG4D_HOME`, and send no heartbeat: one delays the end of a flow run by a second.

    A flow takes the storage of its results from the flow that calls it, so the current flow run gets that storage too.
    The transaction of a calling task, such as that of an item of a catalog, is hidden: steps would be recorded, and
    their locks freed, only when that task ends.

    Args:
        settings: further settings of Prefect.
    """
    records = home.records()
    records.mkdir(parents=True, exist_ok=True)
    changes = {PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None, PREFECT_LOCAL_STORAGE_PATH: records}
    with ExitStack() as contexts:
        contexts.enter_context(temporary_settings({**changes, **(settings or {})}))
        contexts.callback(Transaction.__var__.reset, Transaction.__var__.set(None))  # type: ignore[arg-type]
        if current := FlowRunContext.get():
            storage = {"result_storage": LocalFileSystem(basepath=str(records))}
            store = current.result_store.model_copy(update=storage)
            contexts.enter_context(current.model_copy(update={"result_store": store}))
        yield


_waited: dict[str, float] = {}  # seconds a task run waited for its turn, by its id
_finished: defaultdict[UUID, list[StepRun]] = defaultdict(list)  # by flow run

CACHED: dict[str, Any] = {
    "task_run_name": task_run_name,
    "cache_policy": RequestPolicy(request_for=request_for).configure(
        isolation_level=IsolationLevel.SERIALIZABLE, lock_manager=FileLocks(home.locks)
    ),
    "persist_result": True,
    "result_serializer": "json",
    "retries": RETRIES,
    "retry_delay_seconds": exponential_backoff(RETRY_DELAY_S),
    "retry_condition_fn": should_retry,
    "on_completion": [note_end],
    "on_failure": [note_end],
}  # options of every task that runs a step


class _Shown:
    """Pages and progress of a step in the Prefect UI."""

    def __init__(self) -> None:
        self._progress: _Progress | None = None

    def on_slot(self, waited_s: float) -> None:
        _waited[runtime.task_run.id] = waited_s

    def on_progress(self, label: str, item: str, done: int, total: int, values: dict[str, float]) -> None:
        if self._progress is None:
            self._progress = _Progress(f"progress-{pages.key(label, item)}", f"{label} of {markdown(item)}")
        self._progress.update(done, total, values)

    def on_picture(self, label: str, item: str, picture: bytes) -> None:
        """Store a picture of the running fit and link it in an artifact; errors are ignored."""
        with suppress(httpx.HTTPError, DG4DError, OSError):
            ref = home.store().put_bytes(picture, "image/png")
            create_image_artifact(
                pages.address("picture", ref, ".png"),
                key=f"{pages.LIVE}{pages.key(label, item)}",
                description=f"{label} of {markdown(item)}, so far",
            )

    def on_failure(self, label: str, item: str, error: StepError) -> None:
        page = pages.failure_page(label, item, error, home.store())
        create_page(pages.key(label, item), page, markdown(f"{label} of {item} failed"))

    def on_result(self, label: str, item: str, result: StepResult) -> None:
        self.on_progress(label, item, 1, 1, {})
        for note in (*result.provenance.notes, *result.provenance.run_notes):
            get_run_logger().info(note)
        page = pages.step_page(label, item, result, home.store())
        create_page(pages.key(label, item), page, markdown(f"{label} of {item}"))


class _Progress:
    """Progress artifact of a step, updated every few seconds."""

    def __init__(self, key: str, title: str) -> None:
        self._key, self._title = key, title
        self._artifact: Any = None
        self._last = 0.0

    def update(self, done: int, total: int, values: dict[str, float]) -> None:
        now = time.monotonic()
        if now - self._last < PROGRESS_EVERY_S and done < total:
            return
        self._last = now
        figures = "".join(f", {name} {format_number(value)}" for name, value in values.items())
        text, percent = f"{self._title}: {done}/{total}{figures}", 100 * done / max(total, 1)
        revive()
        with suppress(httpx.TransportError):  # the step continues while the server is unavailable
            if self._artifact is None:
                self._artifact = create_progress_artifact(percent, key=self._key, description=text)
            else:
                update_progress_artifact(self._artifact, percent, description=text)
