"""Conversion in this process, without a Prefect server: the same steps, slots, cache records and packages.

Steps run with the configured executor, by default in child processes. Their results are recorded as Prefect records
them, so runs with and without a server reuse each other's steps.
"""

import inspect
import threading
import time
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import copy_context
from pathlib import Path
from typing import Any, Generic, ParamSpec, TypeVar

from flows import home
from flows.convert import convert_job, prepare
from flows.engine import resources
from flows.engine.events import remark_on_output
from flows.engine.executors import stop_all
from flows.engine.file_locks import FileLocks
from flows.engine.free_space import require_free_space
from flows.engine.records import read_record, record_key, recorded, write_record
from flows.engine.requests import in_order, label_of, request_for
from flows.engine.running import RETRIES, RETRY_DELAY_S, NullObserver, fail_step, finish_step, may_succeed, observed_by
from flows.engine.versions import keep_version
from flows.inputs.conversion_job import ConversionJob
from flows.packages.credentials import configured_signer
from flows.packages.flow_result import FlowResult, StepRun
from flows.packages.publish import Files
from flows.packages.report import deliver
from flows.stages import Tasks, conversion_of, convert
from steps.contract import StepRequest, StepResult
from steps.store.artifact_store import StoreUnreachable
from steps.store.files import home as store_home

STOP_POLL_S = 0.5  # between two checks for a stop while another process computes the same step

P = ParamSpec("P")
R = TypeVar("R", bound=StepResult)


def convert_inline(job: ConversionJob, folder: Path, force: bool = True) -> tuple[Files, bool]:
    """Run a job in this process and publish the package in `folder`; see `convert_job`.

    Raises:
        StepError: a step failed; `folder` is unchanged.
        BadInput: the folder cannot be written, the disk is full, or the key cannot sign; `folder` is unchanged.
        KeyboardInterrupt: the user stopped it; finished steps are kept.
    """
    require_free_space(store_home())
    with _stoppable():
        prepare(job)
        return convert_job(job, folder, run_inline, force)


def run_inline(job: ConversionJob, folder: Path) -> FlowResult:
    """Run the steps of a job, record the version and publish its package; if that fails, `folder` is as it was."""
    conversion = conversion_of(job)
    with ThreadPoolExecutor(resources.slots(), "dg4d-step") as pool:
        engine = _Engine(pool)
        try:
            package, _ = convert(job, conversion, engine.tasks, must_move=job.moving)
        except KeyboardInterrupt:
            stop_all()  # the pool waits for steps in its threads
            raise
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    wall_s = round((time.time_ns() - conversion.begun_ns) / 1e9, 3)
    result = FlowResult(package=package.package, steps=engine.tasks.finished(), wall_s=wall_s)
    keep_version(home.store(), job, result)
    deliver(job, result, folder, configured_signer(), remark_on_output(job.item))
    return result


class _Engine:
    """Tasks of one conversion, and the runs of its steps."""

    def __init__(self, pool: ThreadPoolExecutor) -> None:
        self._pool = pool
        self._runs: list[StepRun] = []
        self.tasks = Tasks(self.bind, lambda: in_order(tuple(self._runs)))

    def bind(self, call: Callable[P, R]) -> "_Task[P, R]":
        return _Task(call, self._pool, self._runs)


class _Task(Generic[P, R]):
    """Task of a step: cached by its request, retried."""

    def __init__(self, call: Callable[P, R], pool: ThreadPoolExecutor, runs: list[StepRun]) -> None:
        self._call, self._pool, self._runs = call, pool, runs
        self._signature = inspect.signature(call)

    def submit(self, *args: P.args, **kwargs: P.kwargs) -> Future[R]:
        """Run the task in a thread of the pool, in a copy of the current context."""
        context = copy_context()
        return self._pool.submit(lambda: context.run(self, *args, **kwargs))

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Run the task, or take the recorded result of an equal one, and note the run."""
        bound = self._signature.bind(*args, **kwargs)
        bound.apply_defaults()
        step = self._call.__name__
        item, label = bound.arguments["conversion"].item, label_of(step, bound.arguments)
        start, observer = time.monotonic(), NullObserver()

        def compute() -> R:
            with observed_by(observer):
                return self._call(*args, **kwargs)

        try:
            result, cached = _cached(request_for(step, bound.arguments), compute)
        except BaseException as error:
            fail_step(item, label, time.monotonic() - start, isinstance(error, KeyboardInterrupt))
            raise
        seconds = time.monotonic() - start
        self._runs.append(finish_step(item, label, result, cached, seconds, observer.waited_s))
        typed: R = self._signature.return_annotation.model_validate(result.model_dump())
        return typed


def _cached(request: StepRequest, compute: Callable[[], StepResult]) -> tuple[StepResult, bool]:
    """Return the recorded result of a request, or compute and record it; the boolean is true if it was recorded."""
    key = record_key(request)
    record = home.records() / key
    with _locked(key):
        try:
            found = recorded(record, home.store())
        except StoreUnreachable:  # a record that cannot be checked is used
            found = read_record(record)
        if found is not None:
            return found, True
        result = _retried(compute)
        write_record(record, result)
        return result, False


def _retried(compute: Callable[[], StepResult]) -> StepResult:
    """Call a function up to `RETRIES` times more while another attempt may succeed."""
    attempt = 1
    while True:
        try:
            return compute()
        except Exception as error:
            if attempt > RETRIES or not may_succeed(error, attempt):
                raise
        resources.stopping.wait(RETRY_DELAY_S * 2 ** (attempt - 1))
        attempt += 1


@contextmanager
def _locked(key: str) -> Iterator[None]:
    """Hold the lock of a record, which Prefect's transactions take too."""
    holder = uuid.uuid4().hex
    while not _LOCKS.acquire_lock(key, holder, acquire_timeout=STOP_POLL_S):
        if resources.stopping.is_set():
            raise resources.Stopped("stopped while another process runs the same step")
    try:
        yield
    finally:
        _LOCKS.release_lock(key, holder)


@contextmanager
def _stoppable() -> Iterator[None]:
    """Allow steps again after a stop by the user, when the last conversion of this process has ended."""
    with _mutex:
        _active.append(1)
    try:
        yield
    finally:
        with _mutex:
            _active.pop()
            if not _active:
                resources.stopping.clear()


_LOCKS = FileLocks(home.locks)
_mutex = threading.Lock()
_active: list[Any] = []
