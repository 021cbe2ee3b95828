"""Execution of a pipeline step inside a Prefect task: request, cache key, retries, progress and artifacts."""

import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime
from typing import Any, TypeVar
from uuid import UUID

import httpx
from prefect import runtime
from prefect.artifacts import create_progress_artifact, update_progress_artifact
from prefect.client.schemas.objects import State, TaskRun
from prefect.context import FlowRunContext
from prefect.exceptions import TerminationSignal
from prefect.filesystems import LocalFileSystem
from prefect.logging import get_run_logger
from prefect.settings import PREFECT_FLOWS_HEARTBEAT_FREQUENCY, PREFECT_LOCAL_STORAGE_PATH, temporary_settings
from prefect.tasks import Task, exponential_backoff
from prefect.transactions import IsolationLevel
from pydantic import Field

from dg4d_lib.settings import Settings
from flows import home
from flows.engine import resources
from flows.engine.caching import FileLocks, RequestPolicy
from flows.engine.events import StepEvent, emit
from flows.engine.executors import configured_executor, stop_all
from flows.engine.leases import hold
from flows.engine.orphans import claim_run
from flows.engine.remarks import remark
from flows.formatting.escaping import markdown
from flows.formatting.numbers import format_number
from flows.packages.flow_result import StepRun
from flows.step_errors import StepCrashed, StepError, StepOutOfMemory, StepUnreachable
from flows.ui import pages
from flows.ui.showing import create_page, revive
from steps.contract import LARGEST_SEED, ArtifactRef, Frozen, StepRequest, StepResult
from steps.profiles import PipelineSettings, step_settings
from steps.runtime.installed_code import catalog, request_version
from steps.runtime.weights import identities, weights_in
from steps.store.artifact_store import StoreUnreachable

PROGRESS_EVERY_S = 3.0  # between two updates of a progress artifact
RETRIES = 2
RETRY_DELAY_S = 2.0  # doubled with each retry
CPU, GPU = "resource:cpu", "resource:gpu"  # tags; Prefect keeps a thread and a client for every set of tags

Result = TypeVar("Result", bound=StepResult)


class Conversion(Frozen):
    """Values that all steps of one conversion share.

    Attributes:
        item: name of the asset.
        settings: settings of the whole pipeline; a step reads its sections.
        seed: seed of every step.
        begun_ns: start of the conversion, nanoseconds since the epoch; earlier conversions go first on a machine.
        mesh_parts: number of tasks that extract a mesh per frame; 0: one per slot of this machine.
    """

    item: str
    settings: PipelineSettings
    seed: int = Field(0, ge=0, le=LARGEST_SEED)
    begun_ns: int = Field(default_factory=time.time_ns)
    mesh_parts: int = 0


class Part(Frozen):
    """Frames that one task of a divided step works on: from `first_frame` up to, not including, `end_frame`."""

    number: int
    of: int
    first_frame: int
    end_frame: int

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"


def request_for(step: str, arguments: Mapping[str, Any]) -> StepRequest:
    """Return the request of a step, made from the arguments of its task.

    Artifacts go to the input ports of their name: an `ArtifactRef` by the name of the argument, the outputs of an
    earlier step by their own names; the results in a list go to a port that takes many, numbered. A `Part` and
    every other value become settings of the step, unless its whole settings are among the arguments.
    """
    spec = catalog()[step]
    inputs: dict[str, ArtifactRef] = {}
    values: dict[str, Any] = {}
    settings: Settings | None = None
    conversion: Conversion = arguments["conversion"]
    for name, value in arguments.items():
        match value:
            case Conversion() | None:
                pass
            case ArtifactRef():
                inputs[name] = value
            case StepResult():
                inputs |= {port: ref for port, ref in value.outputs.items() if spec.input_port(port)}
            case [StepResult(), *_]:
                inputs |= {
                    f"{port}_{number:03d}": ref
                    for number, result in enumerate(value)
                    for port, ref in result.outputs.items()
                    if port in spec.inputs
                }
            case Settings():
                settings = value
            case Part():
                values |= {"first_frame": value.first_frame, "end_frame": value.end_frame}
            case _:
                values[name] = value
    settings = settings or step_settings(step, conversion.settings, **values)
    tree = settings.model_dump(mode="json")
    return StepRequest(
        step=step,
        version=request_version(spec),
        inputs=inputs,
        settings=tree,
        seed=conversion.seed,
        weights=identities(weights_in(tree)),
    )


def run_step(step: str, result_type: type[Result], **arguments: Any) -> Result:
    """Run a step in the current task run, and show its progress and its outputs in the Prefect UI.

    Args:
        step: name in the catalog, and of the task.
        result_type: class of the result.
        arguments: arguments of the task by name; see `request_for`.

    Raises:
        StepError: the step did not finish.
    """
    request, conversion = request_for(step, arguments), arguments["conversion"]
    item, label = conversion.item, label_of(step, arguments)
    key = pages.key(label, item)
    progress = _Progress(f"progress-{key}", f"{label} of {markdown(item)}")
    emit(StepEvent(item, label, "started"))

    def on_progress(done: int, total: int, values: dict[str, float]) -> None:
        emit(StepEvent(item, label, "progress", done=done, total=total, values=values))
        progress.update(done, total, values)

    def say(text: str) -> None:
        emit(StepEvent(item, label, "note", text=text))

    try:
        turn = resources.Turn(conversion.begun_ns, f"{label} of {item}")
        with resources.slot(resources.resource_of(request), say, turn) as waited_s:
            _waited[runtime.task_run.id] = waited_s
            result = configured_executor()(catalog()[step], request, on_progress, say)
    except StepError as error:
        create_page(key, pages.failure_page(label, item, error, home.store()), markdown(f"{label} of {item} failed"))
        raise
    progress.update(1, 1, {})
    for note in (*result.provenance.notes, *result.provenance.run_notes):
        get_run_logger().info(note)
    create_page(key, pages.step_page(label, item, result, home.store()), markdown(f"{label} of {item}"))
    return result_type.model_validate(result.model_dump())


def label_of(step: str, arguments: Mapping[str, Any]) -> str:
    """Return the name of a step, with the part of its frames where they were divided: `extract_mesh 1/3`."""
    part = arguments.get("part")
    return f"{step} {part}" if part else step


def task_run_name() -> str:
    """Return the name of the current task run: `extract_mesh 1/3: fox`."""
    arguments = runtime.task_run.parameters
    return f"{label_of(runtime.task_run.task_name, arguments)}: {arguments['conversion'].item}"


def should_retry(_task: Task[..., Any], run: TaskRun, state: State[Any]) -> bool:
    """Return true if a failed task run may succeed now: memory or the store may be available, a crash gets one retry.

    A run that the user stopped is not retried.
    """
    error = state.result(raise_on_failure=False)
    if resources.stopping.is_set():
        return False
    if isinstance(error, StepOutOfMemory | StepUnreachable | StoreUnreachable):
        return True
    return isinstance(error, StepCrashed | OSError) and run.run_count <= 1


def note_end(task: Task[..., Any], run: TaskRun, state: State[Any]) -> None:
    """Record the end of a task run, computed, cached or failed, and emit its event."""
    label, _, item = run.name.partition(": ")
    seconds = (datetime.now(UTC) - run.start_time).total_seconds() if run.start_time else 0.0
    waited_s = _waited.pop(str(run.id), 0.0)
    if not state.is_completed():
        emit(StepEvent(item, label, "failed", seconds=seconds))
        return
    result = state.result(raise_on_failure=False)
    assert isinstance(result, StepResult) and run.flow_run_id  # tasks of steps return one, and run in flows
    cached = state.name == "Cached"
    if cached:
        hold(home.store(), item, (ref.digest for ref in result.outputs.values()))
    _finished[run.flow_run_id].append(
        StepRun(label=label, cached=cached, wall_s=round(seconds, 3), waited_s=round(waited_s, 3), result=result)
    )
    remark(item, label, result)
    emit(StepEvent(item, label, "finished", seconds=seconds, waited_s=waited_s, cached=cached))


def finished_steps() -> list[StepRun]:
    """Return the step runs of the current flow run so far, in the order of the catalog, parts by their numbers."""
    order = {name: position for position, name in enumerate(catalog())}

    def position(done: StepRun) -> tuple[int, int]:
        step, _, part = done.label.partition(" ")
        return order[step], int(part.partition("/")[0] or 0)

    return sorted(_finished[UUID(runtime.flow_run.id)], key=position)


@contextmanager
def steps_of_flow() -> Iterator[None]:
    """Label the current flow run with its process; kill its steps if the user stops it."""
    flow_run = UUID(runtime.flow_run.id)
    claim_run()
    try:
        yield
    except (KeyboardInterrupt, TerminationSignal):
        stop_all()  # Prefect waits for tasks in other threads
        raise
    finally:
        _finished.pop(flow_run, None)


@contextmanager
def flow_context(settings: Mapping[Any, Any] | None = None) -> Iterator[None]:
    """Keep records of results under `$DG4D_HOME`, and send no heartbeat: one delays the end of a flow run by a second.

    A flow takes the storage of its results from the flow that calls it, so the current flow run gets that storage too.

    Args:
        settings: further settings of Prefect.
    """
    records = home.records()
    records.mkdir(parents=True, exist_ok=True)
    changes = {PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None, PREFECT_LOCAL_STORAGE_PATH: records}
    with ExitStack() as contexts:
        contexts.enter_context(temporary_settings({**changes, **(settings or {})}))
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
        with suppress(httpx.TransportError):  # the step goes on while the server is away
            if self._artifact is None:
                self._artifact = create_progress_artifact(percent, key=self._key, description=text)
            else:
                update_progress_artifact(self._artifact, percent, description=text)
