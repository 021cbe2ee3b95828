"""Flows that convert many jobs, a few at a time; a failed one does not stop the others."""

import signal
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from prefect import flow, task
from prefect.cache_policies import NO_CACHE
from prefect.context import FlowRunContext
from prefect.exceptions import TerminationSignal
from prefect.futures import PrefectFuture
from prefect.task_runners import TaskRunner

from flows import home
from flows.catalog_request import CatalogRequest, ready
from flows.convert import convert_job, save_pictures
from flows.engine import leases
from flows.engine.executors import stop_all
from flows.engine.item_runs import failure, item_deployment
from flows.engine.orphans import claim_run
from flows.engine.runners import item_runner
from flows.engine.step_tasks import flow_context
from flows.inputs.conversion_job import ConversionJob
from flows.inputs.manifest import Item
from flows.inputs.places import parse_where
from flows.packages.delivery import remove_expired
from flows.packages.summary import BatchProgress, Row, with_verdict
from flows.processes import repeated
from flows.ui.gallery import Gallery
from steps.contract import ArtifactRef

Convert = Callable[[ConversionJob, Path], tuple[Any, bool]]

JOBS_MEDIA_TYPE = "application/vnd.dg4d.orders+jsonl"
RETRY_NOTE = " (will be retried at the end)"  # in the message of a crashed item


@flow(name="catalog", flow_run_name="{title}", persist_result=False)
def catalog(request: CatalogRequest, title: str) -> None:
    """Convert every item of a folder, a pattern, an object store or a manifest that is not converted yet."""
    claim_run()
    _convert_catalog(request, title)


@flow(name="convert-jobs", flow_run_name="{title}", persist_result=False)
def convert_jobs(jobs: ArtifactRef, out: Path, workers: int, title: str) -> None:
    """Convert every job of a list in the store: JSON, one per line."""
    claim_run()
    _convert_jobs(jobs, out, workers, title)


def run_catalog(request: CatalogRequest, title: str, progress: BatchProgress, items: list[Item]) -> None:
    """Convert a catalog within the current flow run, or in a new run if there is none.

    Args:
        request: the catalog.
        title: name of the new run.
        progress: holds the rows of items that need no conversion, and receives all others.
        items: of the catalog, so that it is not read again.

    Raises:
        KeyboardInterrupt: the user stopped the catalog; finished items stay, and `progress` has their rows.
    """
    with flow_context(), _reporting(request.out, progress, items):
        (catalog if FlowRunContext.get() is None else _convert_catalog)(request, title)


def run_jobs(jobs: list[ConversionJob], out: Path, workers: int, title: str, progress: BatchProgress) -> None:
    """Convert jobs as `run_catalog` converts a catalog."""
    lines = "".join(f"{job.model_dump_json()}\n" for job in jobs)
    listed = home.store().put_bytes(lines.encode(), JOBS_MEDIA_TYPE)
    with flow_context(), _reporting(out, progress):
        (convert_jobs if FlowRunContext.get() is None else _convert_jobs)(listed, out, workers, title)


def convert_all(
    todo: Iterable[ConversionJob | Row],
    out: Path,
    workers: int,
    title: str,
    progress: BatchProgress,
    strict: bool = False,
    where: str = "",
    work: Convert = convert_job,
) -> None:
    """Convert items within the current flow run; retry crashed ones once at the end.

    Args:
        todo: jobs, and rows of items that need no conversion; read one item ahead.
        out: folder of the packages.
        workers: items at a time.
        title: title of the gallery in the UI.
        progress: receives the row of every item, again after a retry.
        strict: an item that a quality gate rejects counts as failed, and no other is started.
        where: place where items run; see `flows.inputs.places.parse_where`.
        work: converts a job into a folder, here or on the Dask cluster; returns true as second value if every step was
            cached.

    Raises:
        BadInput: `where` is invalid.
        KeyboardInterrupt: the user stopped the catalog; finished items stay, and `progress` has their rows.
    """
    place = parse_where(where)
    if place.kind == "deployment":
        work = item_deployment(place.address, workers).convert_job
        remove_expired(home.store())
    gallery = Gallery(title, progress, out)
    with item_runner(place, workers) as runner:
        try:
            with repeated(signal.SIGTERM):
                for attempt in (1, 2):
                    todo = list(_attempt(attempt, todo, out, workers, progress, strict, work, gallery, runner))
        except (KeyboardInterrupt, TerminationSignal):  # Prefect raises its own for SIGTERM
            stop_all()
            raise
    gallery.finish()


@task(name="convert", task_run_name="convert {item}", cache_policy=NO_CACHE, persist_result=False)
def convert(item: str, job: str, out: str, strict: bool, attempt: int, work: Convert) -> tuple[dict[str, Any], bool]:
    """Convert one job; return its row, also of a failure, and true if a second attempt may succeed.

    The job is passed as JSON, since Prefect searches the fields of objects for futures.
    """
    start = time.monotonic()
    row, may_heal = _converted(ConversionJob.model_validate_json(job), Path(out) / item, strict, work)
    row = row.model_copy(update={"wall_s": round(time.monotonic() - start, 1), "attempts": attempt})
    return row.model_dump(mode="json"), may_heal


_reported: dict[Path, tuple[BatchProgress, Sequence[Item]]] = {}  # by output folder


@contextmanager
def _reporting(out: Path, progress: BatchProgress, items: Sequence[Item] = ()) -> Iterator[None]:
    """Let the catalog of this process that writes to `out` report to `progress`, and skip the rows that it has.

    Without it, as in a resumed flow run, the catalog reads and checks every item again.
    """
    _reported[out] = progress, items
    try:
        yield
    finally:
        del _reported[out]


def _convert_catalog(request: CatalogRequest, title: str) -> None:
    if request.out in _reported:
        progress, items = _reported[request.out]
    else:
        items = request.items()
        progress = BatchProgress(len(items))
    todo = (ready(item, request.out, request.strict) for item in items if item.name not in progress.rows)
    with leases.running(home.store(), str(request.out)):  # protects the source that is read ahead
        convert_all(todo, request.out, request.workers, title, progress, request.strict, request.where)


def _convert_jobs(jobs: ArtifactRef, out: Path, workers: int, title: str) -> None:
    lines = home.store().path(jobs).read_bytes().splitlines()
    todo = (ConversionJob.model_validate_json(line) for line in lines)
    progress = _reported[out][0] if out in _reported else BatchProgress(len(lines))
    with leases.running(home.store(), str(out), [jobs]):
        convert_all(todo, out, workers, title, progress)


def _attempt(
    attempt: int,
    todo: Iterable[ConversionJob | Row],
    out: Path,
    workers: int,
    progress: BatchProgress,
    strict: bool,
    work: Convert,
    gallery: Gallery,
    runner: TaskRunner[Any],
) -> Iterator[ConversionJob]:
    """Convert everything in `todo`; yield the jobs that crashed and may succeed in a second attempt."""
    running: dict[PrefectFuture[Any], ConversionJob] = {}
    finished: SimpleQueue[PrefectFuture[Any]] = SimpleQueue()

    def settled() -> Iterator[ConversionJob]:
        future = finished.get()
        job = running.pop(future)
        content, may_heal = future.result()
        row = Row.model_validate(content)
        if attempt > 1:
            row.wall_s = round(row.wall_s + progress.rows[job.item].wall_s, 1)
        if may_heal and attempt == 1:
            row.message += RETRY_NOTE
            yield job
        progress.settle(row)
        gallery.update()

    for one in todo:
        while len(running) >= workers or not finished.empty():
            yield from settled()
        if isinstance(one, Row):
            progress.settle(one)
            gallery.update()
        elif strict and progress.refused:
            progress.settle(_not_started(one, progress))
        else:
            parameters = {
                "item": one.item,
                "job": one.model_dump_json(),
                "out": str(out),
                "strict": strict,
                "attempt": attempt,
                "work": work,
            }
            future: PrefectFuture[Any] = runner.submit(convert, parameters)
            running[future] = one
            future.add_done_callback(finished.put)
    while running:
        yield from settled()


def _not_started(job: ConversionJob, progress: BatchProgress) -> Row:
    """Return the row of an item that a strict batch does not start, or does not retry, after a refused one."""
    reason = f"{progress.refused} was not accepted"
    if crashed := progress.rows.get(job.item):
        message = f"{crashed.message.removesuffix(RETRY_NOTE)} (not retried: {reason})"
        return crashed.model_copy(update={"message": message})
    return Row(item=job.item, source=job.source_name, status="skipped", message=f"not started: {reason}")


def _converted(job: ConversionJob, folder: Path, strict: bool, work: Convert) -> tuple[Row, bool]:
    row = Row(item=job.item, source=job.source_name, status="failed")
    try:
        _, cached = work(job, folder)
    except Exception as error:  # must not stop the other items
        outcome = failure(error)
        pictures = [str(path) for path in save_pictures(job, error)]
        facts = {"message": outcome.message, "kind": outcome.kind, "pictures": pictures}
        return row.model_copy(update=facts), outcome.may_heal
    done = row.model_copy(update={"status": "done", "message": "every step was already done" if cached else ""})
    return with_verdict(done, folder, strict), False
