"""Many orders in one parent run: a few at a time, each in a flow run of its own; a bad one stops no other."""

import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from prefect import flow, task
from prefect.artifacts import create_table_artifact
from prefect.cache_policies import NO_CACHE
from prefect.settings import PREFECT_FLOWS_HEARTBEAT_FREQUENCY, temporary_settings
from prefect.task_runners import ThreadPoolTaskRunner

from dg4d_lib.errors import DG4DError
from flows.executors import StepError
from flows.make import make, save_pictures
from flows.orders import Order
from flows.summary import NOT_ACCEPTED, Row, judged

Settle = Callable[[Row], None]


@flow(name="catalog", flow_run_name="{title}", persist_result=False)
def catalog(orders: list[Order], out: str, title: str, strict: bool = False) -> list[dict[str, Any]]:
    """Make every order into `out`/<item>; a row of the summary for each, whatever happened to it."""
    futures = [convert.submit(order, out, strict) for order in orders]
    rows = [future.result() for future in futures]
    create_table_artifact(table=rows, key="catalog", description=title)
    return rows


@task(name="convert", task_run_name="convert {order.item}", cache_policy=NO_CACHE, persist_result=False)
def convert(order: Order, out: str, strict: bool = False) -> dict[str, Any]:
    """Make one order; a failure is a row too, and so is what a strict batch did not begin."""
    start = time.monotonic()
    if _refused:
        row = Row(item=order.item, source=order.source_name, status="skipped", message=_reason())
    else:
        row = _converted(order, Path(out) / order.item, strict)
        row = row.model_copy(update={"seconds": round(time.monotonic() - start, 1)})
    with _one_at_a_time:
        if row.kind == NOT_ACCEPTED:
            _refused.append(row.item)
        for settle in _settlers:
            settle(row)
    return row.model_dump(mode="json")


def convert_all(
    orders: list[Order],
    out: Path,
    workers: int,
    title: str,
    settle: Settle,
    strict: bool = False,
    refused: Sequence[str] = (),
) -> None:
    """Run the batch, `workers` items at a time, and hand every finished item to `settle`.

    Args:
        orders: what to make.
        out: the folder of the packages.
        workers: items at a time.
        title: of the run in the UI.
        settle: called with the row of every item.
        strict: an item that a gate does not let pass counts as failed, and no other is begun after it.
        refused: items made before that a strict batch does not accept; with any, none is begun.
    """
    _settlers.append(settle)
    _refused.extend(refused)
    try:
        runner: Any = ThreadPoolTaskRunner(max_workers=workers)
        with temporary_settings({PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None}):  # a second at the end of every flow
            catalog.with_options(task_runner=runner)(orders, str(out), title, strict)
    finally:
        _settlers.remove(settle)
        _refused.clear()


_settlers: list[Settle] = []
_refused: list[str] = []
_one_at_a_time = threading.Lock()


def _reason() -> str:
    return f"not begun: {_refused[0]} was not accepted"


def _converted(order: Order, folder: Path, strict: bool) -> Row:
    row = Row(item=order.item, source=order.source_name, status="failed")
    try:
        _, cached = make(order, folder)
    except (StepError, DG4DError) as error:
        pictures = [str(path) for path in save_pictures(order, error)]
        message = error.message if isinstance(error, StepError) else str(error)
        return row.model_copy(update={"message": message, "kind": type(error).__name__, "pictures": pictures})
    except Exception as error:  # whatever it is, it is this item's own
        return row.model_copy(update={"message": f"{type(error).__name__}: {error}", "kind": "Crashed"})
    done = row.model_copy(update={"status": "done", "message": "every step was already done" if cached else ""})
    return judged(done, folder, strict)
