"""One Prefect task runs every step: cached by its request's digest, tried again when that may help, shown in the UI."""

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Self

import httpx
from prefect import task
from prefect.artifacts import (
    create_link_artifact,
    create_markdown_artifact,
    create_progress_artifact,
    create_table_artifact,
    update_progress_artifact,
)
from prefect.cache_policies import CachePolicy
from prefect.client.schemas.objects import State, TaskRun
from prefect.exceptions import TerminationSignal
from prefect.futures import PrefectFuture
from prefect.logging import get_run_logger
from prefect.settings import PREFECT_FLOWS_HEARTBEAT_FREQUENCY
from prefect.tasks import Task, exponential_backoff
from prefect.transactions import IsolationLevel
from pydantic import BaseModel

from flows import home
from flows.engine import resources
from flows.engine.caching import FileLocks, RequestPolicy
from flows.engine.events import StepEvent, tell
from flows.engine.executors import StepCrashed, StepError, StepOutOfMemory, StepUnreachable, chosen, stop_all
from flows.engine.leases import hold
from flows.engine.remarks import remark
from flows.ui import pages
from flows.ui.curves import amount
from flows.ui.escaping import markdown
from flows.ui.showing import Beside, later, revive, show
from steps.contract import ArtifactRef, StepRequest, StepResult
from steps.runtime.installed_code import catalog, request_version
from steps.runtime.weights import identities, weights_in
from steps.store.artifact_store import StoreUnreachable

STOPS = (KeyboardInterrupt, TerminationSignal)  # how a user stops a flow
PROGRESS_PAGE_EVERY_S = 3.0
QUICK = {PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None}  # settings: a flow waits a second at its end for its heart to stop
RETRIES = 2
RETRY_DELAY_S = 2.0  # doubled each time
PROGRESS_DONE = 100.0


class Finished(BaseModel):
    """One step of one asset, done.

    Attributes:
        label: the step, and the part of its work where it was divided.
        cached: whether the result was there already.
        wall_s: seconds from asking for it to having it; parts that run side by side share them.
        waited_s: seconds of these in which it waited for its turn on the machine.
        result: what it gave.
    """

    label: str
    cached: bool
    wall_s: float
    waited_s: float = 0.0
    result: StepResult


class Made(BaseModel):
    """Result of a flow: the package, and the steps that made it.

    Attributes:
        package: a zip.
        steps: in the order in which they were asked for.
        flow_run: its id.
        wall_s: seconds on the clock from the first step to the last.
    """

    package: ArtifactRef
    steps: list[Finished]
    flow_run: str = ""
    wall_s: float = 0.0


@task(name="run_step", persist_result=True, result_serializer="json", cache_result_in_memory=False)
def run_step(request: StepRequest, item: str, label: str) -> dict[str, Any]:
    """Run one step for one item and show in the UI how far it is and what came out."""
    spec = catalog()[request.step]
    page = _ProgressPage(item, label)
    tell(StepEvent(item, label, "started"))

    def on_progress(done: int, total: int, values: dict[str, float]) -> None:
        tell(StepEvent(item, label, "progress", done=done, total=total, values=values))
        page.update(done, total, values)

    def say(text: str) -> None:
        tell(StepEvent(item, label, "note", text=text))

    try:
        turn = resources.Turn(_begun.get(item, time.time_ns()), f"{label} of {item}")
        with resources.slot(resources.resource_of(request), say, turn) as waited_s:
            _waited[item, label] = waited_s
            result = chosen()(spec, request, on_progress, say)
    except StepError as error:
        show(
            create_markdown_artifact,
            key=pages.key(label, item),
            markdown=pages.failure_page(label, item, error, home.store()),
            description=f"{label} of {markdown(item)} failed",
        )
        raise
    page.update(1, 1, {})
    for note in (*result.provenance.notes, *result.provenance.run_notes):
        get_run_logger().info(note)
    later(partial(_show_result, item, label, result))
    return result.model_dump(mode="json")


def _show_result(item: str, label: str, result: StepResult) -> None:
    """A page, a table of the files, and a link to the first of them."""
    spec = catalog()[result.provenance.step]
    show(
        create_markdown_artifact,
        key=pages.key(label, item),
        markdown=pages.step_page(label, item, result, home.store()),
        description=f"{label} of {markdown(item)}",
    )
    show(
        create_table_artifact,
        key=pages.key(f"outputs {label}", item),
        table=pages.output_rows(result, spec),
        description=f"Files that {label} of {markdown(item)} made",
    )
    name, ref = next(iter(result.outputs.items()))
    show(
        create_link_artifact,
        key=pages.key(f"file {label}", item),
        link=pages.address(name, ref, spec.outputs[name].suffix),
        link_text=f"{name}{spec.outputs[name].suffix}",
        description=f"What {label} of {markdown(item)} made",
    )


def may_help(_task: Task[..., Any], run: TaskRun, state: State[Any]) -> bool:
    """Whether to try again: memory may be free, the store back; a crash gets one more chance, bad input stays bad.

    What the user stopped is not begun again.
    """
    error = state.result(raise_on_failure=False)
    if resources.stopping.is_set():
        return False
    if isinstance(error, StepOutOfMemory | StepUnreachable | StoreUnreachable):
        return True
    return isinstance(error, StepCrashed | OSError) and run.run_count <= 1


@dataclass
class Steps:
    """Asks for the steps of one asset, one after the other, and remembers what each gave.

    Used in a `with` block, at the end of which the pages of all steps are there.

    Attributes:
        item: name of the asset.
        seed: of every step.
        finished: the steps so far, in the order in which they were asked for.
    """

    item: str
    seed: int
    finished: list[Finished] = field(default_factory=list)
    _makers: dict[str, State[Any]] = field(default_factory=dict)
    _pages: Beside = field(default_factory=Beside)
    _begun: float = field(default_factory=time.monotonic)

    @property
    def wall_s(self) -> float:
        """Seconds on the clock since the first step was asked for."""
        return time.monotonic() - self._begun

    def __enter__(self) -> Self:
        _begun[self.item] = time.time_ns()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        stopped = kind is not None and issubclass(kind, STOPS)
        if stopped:
            stop_all()  # parts that run side by side would be waited for
        self._pages.finish(stopped=stopped)
        _begun.pop(self.item, None)

    def run(self, step: str, inputs: dict[str, ArtifactRef | None], settings: BaseModel) -> dict[str, ArtifactRef]:
        """Run a step, or take what it gave before; its outputs by name. Inputs that are None are left out.

        Raises:
            StepError: the step did not finish.
        """
        request = self._request(step, inputs, settings)
        start = time.monotonic()
        with self._pages.offered():
            state: State[Any] = _task(step)(request, self.item, step, wait_for=self._before(request), return_state=True)
        return self._note(step, state, time.monotonic() - start)

    def run_parts(
        self, step: str, inputs: dict[str, ArtifactRef | None], parts: Sequence[BaseModel]
    ) -> list[dict[str, ArtifactRef]]:
        """Run a step once per settings in `parts`, a few at a time; the outputs of each.

        Raises:
            StepError: one of them did not finish.
        """
        start = time.monotonic()
        futures: list[tuple[str, PrefectFuture[Any]]] = []
        ends: dict[str, float] = {}
        for number, settings in enumerate(parts, 1):
            label = f"{step} {number}/{len(parts)}"
            request = self._request(step, inputs, settings)
            ready = _task(step)
            future = ready.submit(request, self.item, label, wait_for=self._before(request))
            future.add_done_callback(partial(_note_end, ends, label))
            futures.append((label, future))
        for label, future in futures:
            future.wait()
            ends.setdefault(label, time.monotonic())
        return [self._note(label, future.state, ends[label] - start) for label, future in futures]

    def notes(self) -> tuple[str, ...]:
        """What the steps so far have to say about the asset, and not about their run; each sentence once."""
        return tuple(dict.fromkeys(note for done in self.finished for note in done.result.provenance.notes))

    def _request(self, step: str, inputs: dict[str, ArtifactRef | None], settings: BaseModel) -> StepRequest:
        tree = settings.model_dump(mode="json")
        return StepRequest(
            step=step,
            version=request_version(catalog()[step]),
            inputs={name: ref for name, ref in inputs.items() if ref is not None},
            settings=tree,
            seed=self.seed,
            weights=identities(weights_in(tree)),
        )

    def _before(self, request: StepRequest) -> list[State[Any]]:
        """The runs that made the inputs, so that the UI can draw the arrows."""
        digests = {ref.digest for ref in request.inputs.values()}
        return [state for digest, state in self._makers.items() if digest in digests]

    def _note(self, label: str, state: State[Any], seconds: float) -> dict[str, ArtifactRef]:
        if not state.is_completed():
            tell(StepEvent(self.item, label, "failed", seconds=seconds))
            error = state.result(raise_on_failure=False)
            raise error if isinstance(error, BaseException) else StepCrashed(label, str(state.message))
        result = StepResult.model_validate(state.result())
        cached = state.name == "Cached"
        if cached:
            hold(home.store(), self.item, (ref.digest for ref in result.outputs.values()))
        waited_s = _waited.pop((self.item, label), 0.0)
        self.finished.append(
            Finished(label=label, cached=cached, wall_s=round(seconds, 3), waited_s=round(waited_s, 3), result=result)
        )
        for ref in result.outputs.values():
            self._makers[ref.digest] = state
        remark(self.item, label, result)
        tell(StepEvent(self.item, label, "finished", seconds=seconds, waited_s=waited_s, cached=cached))
        return result.outputs


def _note_end(ends: dict[str, float], label: str, _future: PrefectFuture[Any]) -> None:
    ends.setdefault(label, time.monotonic())


_locks: dict[str, FileLocks] = {}
_begun: dict[str, int] = {}  # when the items of this process were begun: they take turns in this order
_waited: dict[tuple[str, str], float] = {}  # seconds that a step of an item waited for its turn


def _task(step: str) -> Task[..., Any]:
    """The task under the step's own name, with its records where `$DG4D_HOME` is."""
    locks = _locks.setdefault(str(home.locks()), FileLocks(home.locks()))
    policy: CachePolicy = RequestPolicy(records=home.records(), store=home.store().address)
    home.records().mkdir(parents=True, exist_ok=True)
    return run_step.with_options(
        name=step,
        task_run_name="{label}: {item}",  # a template: names may have braces
        tags=[f"resource:{catalog()[step].resource}"],  # Prefect makes and keeps a thread and a client per set
        cache_policy=policy.configure(isolation_level=IsolationLevel.SERIALIZABLE, lock_manager=locks),
        result_storage=home.records(),
        retries=RETRIES,
        retry_delay_seconds=exponential_backoff(RETRY_DELAY_S),
        retry_condition_fn=may_help,
    )


class _ProgressPage:
    """The progress bar in the UI, updated every few seconds."""

    def __init__(self, item: str, label: str) -> None:
        self._key, self._what = f"progress-{pages.key(label, item)}", f"{label} of {markdown(item)}"
        self._artifact: Any = None
        self._last = 0.0

    def update(self, done: int, total: int, values: dict[str, float]) -> None:
        now = time.monotonic()
        if now - self._last < PROGRESS_PAGE_EVERY_S and done < total:
            return
        self._last = now
        share = PROGRESS_DONE * done / max(total, 1)
        text = ", ".join(
            [f"{self._what}: {done}/{total}", *(f"{name} {amount(value)}" for name, value in values.items())]
        )
        revive()
        with suppress(httpx.TransportError):  # the step goes on while the server is away
            if self._artifact is None:
                self._artifact = create_progress_artifact(share, key=self._key, description=text)
            else:
                update_progress_artifact(self._artifact, share, description=text)
