"""Many orders in one parent run: a few at a time, each in a flow run of its own; a bad one stops no other."""

import time
from collections.abc import Callable, Iterable, Iterator
from contextvars import ContextVar
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from prefect import flow, task
from prefect.artifacts import create_progress_artifact, create_table_artifact, update_progress_artifact
from prefect.cache_policies import NO_CACHE
from prefect.exceptions import TerminationSignal
from prefect.futures import PrefectFuture
from prefect.settings import temporary_settings

from dg4d_lib.errors import DG4DError
from flows.commands.make import make, save_pictures
from flows.engine.executors import StepCrashed, StepError, StepOutOfMemory, StepTimedOut, StepUnreachable, stop_all
from flows.engine.runners import item_runner
from flows.engine.tasks import QUICK
from flows.inputs.orders import Order
from flows.packages.summary import Row, Tally, judged
from flows.ui import pages
from flows.ui.escaping import markdown
from steps.store.artifact_store import ArtifactMissing, StoreUnreachable

Make = Callable[[Order, Path], tuple[Any, bool]]

ROWS_SHOWN = 100  # of the table on the server, which keeps it in its database
PAGE_EVERY_S = 3.0
MAY_HEAL = (StepCrashed, StepOutOfMemory, StepTimedOut, StepUnreachable, StoreUnreachable, ArtifactMissing)


def convert_all(
    todo: Iterable[Order | Row],
    out: Path,
    workers: int,
    title: str,
    tally: Tally,
    strict: bool = False,
    work: Make = make,
) -> None:
    """Run the batch, `workers` items at a time; what died is tried once more at the end.

    Args:
        todo: what to make, or what became of an item that needs no making; read one item ahead.
        out: the folder of the packages.
        workers: items at a time.
        title: of the run in the UI.
        tally: told the row of every item; again, if it is tried again.
        strict: an item that a gate does not let pass counts as failed, and no other is begun after it.
        work: makes an order into a folder, and says whether every step had been done before.

    Raises:
        KeyboardInterrupt: the user stopped it; what is done stays, and `tally` knows it.
    """

    def rounds() -> None:
        page = _Page(title, tally)
        try:
            dead = list(_rounds(todo, out, workers, tally, strict, work, page, attempt=1))
            list(_rounds(dead, out, workers, tally, strict, work, page, attempt=2))
        except (KeyboardInterrupt, TerminationSignal):  # Prefect's own for SIGTERM, while a flow runs
            stop_all()
            raise
        page.finish()

    token = _body.set(rounds)
    try:
        with temporary_settings(QUICK):
            catalog.with_options(task_runner=item_runner(workers))(title)
    finally:
        _body.reset(token)


@flow(name="catalog", flow_run_name="{title}", persist_result=False)
def catalog(title: str) -> None:
    """The run of a batch; holds nothing of it, for runners send it to their workers."""
    _rounds_of_this_batch()


_body: ContextVar[Callable[[], None]] = ContextVar("body")


def _rounds_of_this_batch() -> None:
    _body.get()()


@task(name="convert", task_run_name="convert {item}", cache_policy=NO_CACHE, persist_result=False)
def convert(item: str, order: str, out: str, strict: bool, attempt: int, work: Make) -> tuple[dict[str, Any], bool]:
    """Make one order, given as JSON: Prefect would look for futures in every knob, and runners for graphs.

    A failure is a row too. Also says whether the same again may go better.
    """
    start = time.monotonic()
    row, may_heal = _converted(Order.model_validate_json(order), Path(out) / item, strict, work)
    row = row.model_copy(update={"wall_s": round(time.monotonic() - start, 1), "attempts": attempt})
    return row.model_dump(mode="json"), may_heal


def _rounds(
    todo: Iterable[Order | Row],
    out: Path,
    workers: int,
    tally: Tally,
    strict: bool,
    work: Make,
    page: "_Page",
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
        page.update()

    for one in todo:
        while len(running) >= workers or not finished.empty():
            yield from settled()
        if isinstance(one, Row):
            tally.settle(one)
            page.update()
        elif strict and tally.refused:
            reason = f"not begun: {tally.refused} was not accepted"
            tally.settle(Row(item=one.item, source=one.source_name, status="skipped", message=reason))
        else:
            future = convert.submit(one.item, one.model_dump_json(), str(out), strict, attempt, work)
            running[future] = one
            future.add_done_callback(finished.put)
    while running:
        yield from settled()


def _converted(order: Order, folder: Path, strict: bool, work: Make) -> tuple[Row, bool]:
    row = Row(item=order.item, source=order.source_name, status="failed")
    try:
        _, cached = work(order, folder)
    except (StepError, DG4DError) as error:
        pictures = [str(path) for path in save_pictures(order, error)]
        message = error.message if isinstance(error, StepError) else str(error)
        told = {"message": message, "kind": type(error).__name__, "pictures": pictures}
        return row.model_copy(update=told), isinstance(error, MAY_HEAL)
    except Exception as error:  # whatever it is, it is this item's own
        return row.model_copy(update={"message": f"{type(error).__name__}: {error}", "kind": "Crashed"}), True
    done = row.model_copy(update={"status": "done", "message": "every step was already done" if cached else ""})
    return judged(done, folder, strict), False


class _Page:
    """How far the batch is, on the server: a bar with a line of numbers, and a table at the end."""

    def __init__(self, title: str, tally: Tally) -> None:
        self._name, self._tally = title.partition(":")[0], tally
        self._key = pages.key("catalog", self._name)
        self._bar: Any = create_progress_artifact(0.0, key=f"progress-{self._key}", description=self._text())
        self._next = 0.0

    def update(self) -> None:
        """Show it, unless that was a moment ago."""
        if time.monotonic() >= self._next:
            update_progress_artifact(self._bar, 100 * self._tally.share, description=self._text())
            self._next = time.monotonic() + PAGE_EVERY_S

    def finish(self) -> None:
        """Show the end, with a table: what failed and what is not accepted first, and not more than can be read."""
        self._next = 0.0
        self.update()
        rows = sorted(self._tally.rows.values(), key=lambda row: (row.status != "failed", not row.failing))
        shown = [_cells(row) for row in rows[:ROWS_SHOWN]]
        more = f"; {ROWS_SHOWN} of {len(rows)} are shown, all are in summary.csv" if len(rows) > ROWS_SHOWN else ""
        create_table_artifact(table=shown, key=self._key, description=f"{self._text()}{more}")

    def _text(self) -> str:
        return f"{markdown(self._name)}: {self._tally.line()}"


def _cells(row: Row) -> dict[str, Any]:
    """What a page has room for, the longest last."""
    return {
        "item": markdown(row.item),
        "status": "not accepted" if row.failing else row.status,
        "wall_s": row.wall_s,
        "asset": f"[page](/artifacts/key/{pages.key('asset', row.item)})" if row.made else "",
        "message": markdown(", ".join(row.failing or ()) or row.message),
    }
