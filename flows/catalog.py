"""Many orders in one run: a few at a time, each in a flow run of its own; a bad one stops no other."""

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
from flows.convert import make, save_pictures
from flows.engine.executors import stop_all
from flows.engine.item_runs import failure, item_deployment
from flows.engine.orphans import claim_run
from flows.engine.runners import item_runner
from flows.engine.step_tasks import flow_context
from flows.inputs.manifest import Item
from flows.inputs.orders import Order
from flows.inputs.places import parse_where
from flows.packages.delivery import forget_shared
from flows.packages.summary import Row, Tally, judged
from flows.ui.gallery import Gallery
from steps.contract import ArtifactRef

Make = Callable[[Order, Path], tuple[Any, bool]]
Allow = Callable[[Item], None]

ORDERS = "application/vnd.dg4d.orders+jsonl"


@flow(name="catalog", flow_run_name="{title}", persist_result=False)
def catalog(request: CatalogRequest, title: str) -> None:
    """Make every item of a folder, a pattern, an object store or a manifest that is not made yet."""
    claim_run()
    convert_catalog(request, title)


@flow(name="convert-orders", flow_run_name="{title}", persist_result=False)
def convert_orders(orders: ArtifactRef, out: Path, workers: int, title: str) -> None:
    """Make every order of a list in the store: JSON, one to a line."""
    claim_run()
    _convert_list(orders, out, workers, title)


def run_catalog(request: CatalogRequest, title: str, tally: Tally, allow: Allow | None = None) -> None:
    """Make a catalog within the current flow run, or in a run of its own where there is none.

    Args:
        request: the catalog.
        title: of a run of its own.
        tally: knows rows of items that need no making, and is told all others.
        allow: raises BadInput for an item that may not be made here; such items are checked in the current run only.

    Raises:
        KeyboardInterrupt: the user stopped it; what is done stays, and `tally` knows it.
    """
    with flow_context(), _known(request.out, tally):
        if FlowRunContext.get() is None:
            catalog(request, title)
        else:
            convert_catalog(request, title, allow)


def run_orders(orders: list[Order], out: Path, workers: int, title: str, tally: Tally) -> None:
    """Make orders as `run_catalog` makes a catalog."""
    lines = "".join(f"{order.model_dump_json()}\n" for order in orders)
    listed = home.store().put_bytes(lines.encode(), ORDERS)
    with flow_context(), _known(out, tally):
        if FlowRunContext.get() is None:
            convert_orders(listed, out, workers, title)
        else:
            _convert_list(listed, out, workers, title)


def convert_catalog(request: CatalogRequest, title: str, allow: Allow | None = None) -> None:
    """Make a catalog within the current flow run; see `run_catalog`."""
    items = request.items(allow)
    tally = _tallies.get(request.out) or Tally(len(items))
    todo = (ready(item, request.out, request.strict) for item in items if item.name not in tally.rows)
    convert_all(todo, request.out, request.workers, title, tally, request.strict, request.where)


def convert_all(
    todo: Iterable[Order | Row],
    out: Path,
    workers: int,
    title: str,
    tally: Tally,
    strict: bool = False,
    where: str = "",
    work: Make = make,
) -> None:
    """Make items within the current flow run, `workers` at a time; what died is tried once more at the end.

    Args:
        todo: what to make, or what became of an item that needs no making; read one item ahead.
        out: the folder of the packages.
        workers: items at a time.
        title: of the gallery in the UI.
        tally: told the row of every item; again, if it is tried again.
        strict: an item that a gate does not let pass counts as failed, and no other is begun after it.
        where: where items are made, as `flows.engine.runners.parse_where` reads it.
        work: makes an order into a folder on this machine or in its cluster, and says whether every step had been done
            before.

    Raises:
        BadInput: `where` is no place for items.
        KeyboardInterrupt: the user stopped it; what is done stays, and `tally` knows it.
    """
    place = parse_where(where)
    if place.kind == "deployment":
        work = item_deployment(place.address, workers).make
        forget_shared(home.store())
    gallery = Gallery(title, tally, out)
    with item_runner(place, workers) as runner:
        try:
            for attempt in (1, 2):
                todo = list(_rounds(todo, out, workers, tally, strict, work, gallery, runner, attempt))
        except (KeyboardInterrupt, TerminationSignal):  # Prefect's own for SIGTERM, while a flow runs
            stop_all()
            raise
    gallery.finish()


@task(name="convert", task_run_name="convert {item}", cache_policy=NO_CACHE, persist_result=False)
def convert(item: str, order: str, out: str, strict: bool, attempt: int, work: Make) -> tuple[dict[str, Any], bool]:
    """Make one order, given as JSON: Prefect would look for futures in every knob, and runners for graphs.

    A failure is a row too. Also says whether the same again may go better.
    """
    start = time.monotonic()
    row, may_heal = _converted(Order.model_validate_json(order), Path(out) / item, strict, work)
    row = row.model_copy(update={"wall_s": round(time.monotonic() - start, 1), "attempts": attempt})
    return row.model_dump(mode="json"), may_heal


_tallies: dict[Path, Tally] = {}


@contextmanager
def _known(out: Path, tally: Tally) -> Iterator[None]:
    """Let the catalog of this process into `out` tell this tally while the block runs, and skip the rows it has.

    A catalog is complete without: it would look at every item again.
    """
    _tallies[out] = tally
    try:
        yield
    finally:
        del _tallies[out]


def _convert_list(orders: ArtifactRef, out: Path, workers: int, title: str) -> None:
    lines = home.store().path(orders).read_bytes().splitlines()
    todo = (Order.model_validate_json(line) for line in lines)
    convert_all(todo, out, workers, title, _tallies.get(out) or Tally(len(lines)))


def _rounds(
    todo: Iterable[Order | Row],
    out: Path,
    workers: int,
    tally: Tally,
    strict: bool,
    work: Make,
    gallery: Gallery,
    runner: TaskRunner[Any],
    attempt: int,
) -> Iterator[Order]:
    """Make everything in `todo`; gives those that died and may live next time."""
    running: dict[PrefectFuture[Any], Order] = {}
    finished: SimpleQueue[PrefectFuture[Any]] = SimpleQueue()

    def settled() -> Iterator[Order]:
        future = finished.get()
        order = running.pop(future)
        content, may_heal = future.result()
        row = Row.model_validate(content)
        if may_heal and attempt == 1:
            row = row.model_copy(update={"message": f"{row.message} (will be tried again at the end)"})
            yield order
        tally.settle(row)
        gallery.update()

    for one in todo:
        while len(running) >= workers or not finished.empty():
            yield from settled()
        if isinstance(one, Row):
            tally.settle(one)
            gallery.update()
        elif strict and tally.refused:
            reason = f"not begun: {tally.refused} was not accepted"
            tally.settle(Row(item=one.item, source=one.source_name, status="skipped", message=reason))
        else:
            parameters = {
                "item": one.item,
                "order": one.model_dump_json(),
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


def _converted(order: Order, folder: Path, strict: bool, work: Make) -> tuple[Row, bool]:
    row = Row(item=order.item, source=order.source_name, status="failed")
    try:
        _, cached = work(order, folder)
    except Exception as error:  # whatever it is, it is this item's own
        outcome = failure(error)
        pictures = [str(path) for path in save_pictures(order, error)]
        told = {"message": outcome.message, "kind": outcome.kind, "pictures": pictures}
        return row.model_copy(update=told), outcome.may_heal
    done = row.model_copy(update={"status": "done", "message": "every step was already done" if cached else ""})
    return judged(done, folder, strict), False
