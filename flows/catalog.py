"""Many jobs in one run: a few at a time, each in a flow run of its own; a bad one stops no other."""

import time
from collections.abc import Callable, Iterable, Iterator
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
from flows.engine.executors import stop_all
from flows.engine.item_runs import failure, item_deployment
from flows.engine.orphans import claim_run
from flows.engine.runners import item_runner
from flows.engine.step_tasks import flow_context
from flows.inputs.conversion_job import ConversionJob
from flows.inputs.manifest import Item
from flows.inputs.places import parse_where
from flows.packages.delivery import forget_shared
from flows.packages.summary import BatchProgress, Row, judged
from flows.ui.gallery import Gallery
from steps.contract import ArtifactRef

Make = Callable[[ConversionJob, Path], tuple[Any, bool]]
Allow = Callable[[Item], None]

JOBS_MEDIA_TYPE = "application/vnd.dg4d.orders+jsonl"


@flow(name="catalog", flow_run_name="{title}", persist_result=False)
def catalog(request: CatalogRequest, title: str) -> None:
    """Make every item of a folder, a pattern, an object store or a manifest that is not made yet."""
    claim_run()
    convert_catalog(request, title)


@flow(name="convert-jobs", flow_run_name="{title}", persist_result=False)
def convert_jobs(jobs: ArtifactRef, out: Path, workers: int, title: str) -> None:
    """Make every job of a list in the store: JSON, one to a line."""
    claim_run()
    _convert_list(jobs, out, workers, title)


def run_catalog(request: CatalogRequest, title: str, progress: BatchProgress, allow: Allow | None = None) -> None:
    """Make a catalog within the current flow run, or in a run of its own where there is none.

    Args:
        request: the catalog.
        title: of a run of its own.
        progress: knows rows of items that need no making, and is told all others.
        allow: raises BadInput for an item that may not be made here; such items are checked in the current run only.

    Raises:
        KeyboardInterrupt: the user stopped it; what is done stays, and `progress` knows it.
    """
    with flow_context(), _known(request.out, progress):
        if FlowRunContext.get() is None:
            catalog(request, title)
        else:
            convert_catalog(request, title, allow)


def run_jobs(jobs: list[ConversionJob], out: Path, workers: int, title: str, progress: BatchProgress) -> None:
    """Make jobs as `run_catalog` makes a catalog."""
    lines = "".join(f"{job.model_dump_json()}\n" for job in jobs)
    listed = home.store().put_bytes(lines.encode(), JOBS_MEDIA_TYPE)
    with flow_context(), _known(out, progress):
        if FlowRunContext.get() is None:
            convert_jobs(listed, out, workers, title)
        else:
            _convert_list(listed, out, workers, title)


def convert_catalog(request: CatalogRequest, title: str, allow: Allow | None = None) -> None:
    """Make a catalog within the current flow run; see `run_catalog`."""
    items = request.items(allow)
    progress = _progress_of.get(request.out) or BatchProgress(len(items))
    todo = (ready(item, request.out, request.strict) for item in items if item.name not in progress.rows)
    convert_all(todo, request.out, request.workers, title, progress, request.strict, request.where)


def convert_all(
    todo: Iterable[ConversionJob | Row],
    out: Path,
    workers: int,
    title: str,
    progress: BatchProgress,
    strict: bool = False,
    where: str = "",
    work: Make = convert_job,
) -> None:
    """Make items within the current flow run, `workers` at a time; what died is tried once more at the end.

    Args:
        todo: what to make, or what became of an item that needs no making; read one item ahead.
        out: the folder of the packages.
        workers: items at a time.
        title: of the gallery in the UI.
        progress: told the row of every item; again, if it is tried again.
        strict: an item that a gate does not let pass counts as failed, and no other is begun after it.
        where: where items are made, as `flows.engine.runners.parse_where` reads it.
        work: makes a job into a folder on this machine or in its cluster, and says whether every step had been done
            before.

    Raises:
        BadInput: `where` is no place for items.
        KeyboardInterrupt: the user stopped it; what is done stays, and `progress` knows it.
    """
    place = parse_where(where)
    if place.kind == "deployment":
        work = item_deployment(place.address, workers).convert_job
        forget_shared(home.store())
    gallery = Gallery(title, progress, out)
    with item_runner(place, workers) as runner:
        try:
            for attempt in (1, 2):
                todo = list(_rounds(todo, out, workers, progress, strict, work, gallery, runner, attempt))
        except (KeyboardInterrupt, TerminationSignal):  # Prefect's own for SIGTERM, while a flow runs
            stop_all()
            raise
    gallery.finish()


@task(name="convert", task_run_name="convert {item}", cache_policy=NO_CACHE, persist_result=False)
def convert(item: str, job: str, out: str, strict: bool, attempt: int, work: Make) -> tuple[dict[str, Any], bool]:
    """Make one job, given as JSON: Prefect would look for futures in every knob, and runners for graphs.

    A failure is a row too. Also says whether the same again may go better.
    """
    start = time.monotonic()
    row, may_heal = _converted(ConversionJob.model_validate_json(job), Path(out) / item, strict, work)
    row = row.model_copy(update={"wall_s": round(time.monotonic() - start, 1), "attempts": attempt})
    return row.model_dump(mode="json"), may_heal


_progress_of: dict[Path, BatchProgress] = {}


@contextmanager
def _known(out: Path, progress: BatchProgress) -> Iterator[None]:
    """Let the catalog of this process into `out` tell this progress while the block runs, and skip the rows it has.

    A catalog is complete without: it would look at every item again.
    """
    _progress_of[out] = progress
    try:
        yield
    finally:
        del _progress_of[out]


def _convert_list(jobs: ArtifactRef, out: Path, workers: int, title: str) -> None:
    lines = home.store().path(jobs).read_bytes().splitlines()
    todo = (ConversionJob.model_validate_json(line) for line in lines)
    convert_all(todo, out, workers, title, _progress_of.get(out) or BatchProgress(len(lines)))


def _rounds(
    todo: Iterable[ConversionJob | Row],
    out: Path,
    workers: int,
    progress: BatchProgress,
    strict: bool,
    work: Make,
    gallery: Gallery,
    runner: TaskRunner[Any],
    attempt: int,
) -> Iterator[ConversionJob]:
    """Make everything in `todo`; gives those that died and may live next time."""
    running: dict[PrefectFuture[Any], ConversionJob] = {}
    finished: SimpleQueue[PrefectFuture[Any]] = SimpleQueue()

    def settled() -> Iterator[ConversionJob]:
        future = finished.get()
        job = running.pop(future)
        content, may_heal = future.result()
        row = Row.model_validate(content)
        if may_heal and attempt == 1:
            row = row.model_copy(update={"message": f"{row.message} (will be tried again at the end)"})
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
            reason = f"not begun: {progress.refused} was not accepted"
            progress.settle(Row(item=one.item, source=one.source_name, status="skipped", message=reason))
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


def _converted(job: ConversionJob, folder: Path, strict: bool, work: Make) -> tuple[Row, bool]:
    row = Row(item=job.item, source=job.source_name, status="failed")
    try:
        _, cached = work(job, folder)
    except Exception as error:  # whatever it is, it is this item's own
        outcome = failure(error)
        pictures = [str(path) for path in save_pictures(job, error)]
        told = {"message": outcome.message, "kind": outcome.kind, "pictures": pictures}
        return row.model_copy(update=told), outcome.may_heal
    done = row.model_copy(update={"status": "done", "message": "every step was already done" if cached else ""})
    return judged(done, folder, strict), False
