"""Summary of a batch: `summary.json` and `summary.csv` for programs, `index.html` for people."""

import csv
import io
import json
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args
from urllib.parse import quote

from pydantic import BaseModel

from flows.formatting.escaping import csv_cell
from flows.formatting.numbers import format_duration
from flows.inputs.package_record import record_of
from flows.packages.acceptance import failing_gates
from flows.packages.html_pages import render
from steps.store.files import DiskFull, write_atomically

Status = Literal["done", "unchanged", "failed", "skipped"]
NOT_ACCEPTED = "NotAccepted"  # kind of failure of a finished item that fails a gate in a strict batch
CSV_COLUMNS = (
    "item", "source", "status", "kind", "message", "attempts", "wall_s", "compute_s", "cpu_s", "gpu_s", "cost",
    "failing",
)  # fmt: skip
WRITE_EVERY_S = 5.0  # least time between two summaries while a batch runs
WRITING_SHARE = 0.05  # largest share of a batch's time for writing the summary


class Row(BaseModel):
    """Result of one item.

    Attributes:
        item: name, and folder below that of the batch.
        source: name of the source, for people.
        status: `unchanged` if the package existed before.
        kind: name of the exception of a failure.
        message: for people.
        attempts: in this batch.
        wall_s: wall-clock seconds of all attempts in this batch, with waiting.
        compute_s: sum of the compute times of its steps, including cached ones.
        cpu_s: CPU seconds of these steps.
        gpu_s: part of `compute_s` in steps that used a GPU.
        pictures: that explain a failure.
        failing: gates; None if there is no verdict.
    """

    item: str
    source: str = ""
    status: Status
    kind: str = ""
    message: str = ""
    attempts: int = 0
    wall_s: float = 0.0
    compute_s: float = 0.0
    cpu_s: float = 0.0
    gpu_s: float = 0.0
    pictures: list[str] = []
    failing: list[str] | None = None

    @property
    def has_package(self) -> bool:
        """True if there is a package, accepted or not."""
        return self.status in {"done", "unchanged"} or self.kind == NOT_ACCEPTED


class BatchProgress:
    """Results of the items of a batch so far; thread-safe.

    Args:
        total: number of items.
        listener: called with every result.
    """

    def __init__(self, total: int, listener: Callable[[Row], None] = lambda row: None) -> None:
        self.total = total
        self.rows: dict[str, Row] = {}
        self._listener = listener
        self._mutex = threading.RLock()  # the listener may read properties
        self._begun = time.monotonic()

    def settle(self, row: Row) -> None:
        """Record the result of an item; a later one replaces it."""
        with self._mutex:
            self.rows[row.item] = row
            self._listener(row)

    @property
    def seconds(self) -> float:
        """Time since the batch began."""
        return time.monotonic() - self._begun

    @property
    def refused(self) -> str:
        """First item that a strict batch does not accept; empty if there is none."""
        with self._mutex:
            return next((row.item for row in self.rows.values() if row.kind == NOT_ACCEPTED), "")

    @property
    def share(self) -> float:
        """Share of finished items, from 0 to 1."""
        return len(self.rows) / max(self.total, 1)

    def line(self) -> str:
        """Return the progress in one line: items, failures, rate, estimated time left."""
        with self._mutex:
            rows = list(self.rows.values())
        worked = [row for row in rows if row.status != "unchanged"]
        parts = [f"{len(rows)} of {self.total} items", f"{sum(row.status == 'failed' for row in rows)} failed"]
        if worked:
            rate = len(worked) / max(self.seconds, 1e-9)
            parts.append(f"{3600 * rate:.0f} an hour" if rate < 1 else f"{rate:.1f} a second")
            if left := self.total - len(rows):
                parts.append(f"about {format_duration(left / rate)} left")
        return ", ".join(parts)


class Writer:
    """Writer of a batch's summary, at intervals and at the end.

    Args:
        out: folder of the batch.
        commercial_only: whether only weights that allow commercial use were allowed.
        price_per_hour: of the machine, in any currency; None: no costs.
    """

    def __init__(self, out: Path, commercial_only: bool = False, price_per_hour: float | None = None) -> None:
        self._out, self._commercial_only, self._price = out, commercial_only, price_per_hour
        self._next = 0.0

    def write_sometimes(self, rows: list[Row], seconds: float) -> None:
        """Call `write` unless it was called recently; writing takes a small share of a batch's time.

        A write that fails, for example in an unavailable network folder, leaves the earlier summary.
        """
        start = time.monotonic()
        if start >= self._next:
            with suppress(OSError, DiskFull):
                self.write(rows, seconds)
            took = time.monotonic() - start
            self._next = start + max(WRITE_EVERY_S, took / WRITING_SHARE)

    def write(self, rows: list[Row], seconds: float) -> None:
        """Write the summary.

        Args:
            rows: results so far.
            seconds: since the batch began.

        Raises:
            DiskFull: the disk is full; the earlier summary stays.
        """
        counts = {status: sum(row.status == status for row in rows) for status in get_args(Status)}
        items = [row.model_dump(mode="json") | {"cost": self._cost(row.compute_s)} for row in rows]
        totals = {name: round(sum(getattr(row, name) for row in rows), 3) for name in ("compute_s", "cpu_s", "gpu_s")}
        summary = {
            "counts": counts,
            "made": sum(row.has_package for row in rows),
            "not_accepted": [row.item for row in rows if row.failing],
            "commercial_only": self._commercial_only,
            "wall_s": round(seconds, 1),
            "totals": totals | {"cost": self._cost(totals["compute_s"])},
            "price_per_hour": self._price,
            "items": items,
        }
        write_atomically(self._out / "summary.json", json.dumps(summary, indent=1, ensure_ascii=False) + "\n")
        write_atomically(self._out / "summary.csv", _csv(items))
        write_atomically(self._out / "index.html", _index(self._out, rows, counts))

    def _cost(self, compute_s: float) -> float | None:
        """Return the cost of a compute time on a machine that does nothing else."""
        return None if self._price is None else round(self._price * compute_s / 3600, 6)


def with_verdict(row: Row, folder: Path, strict: bool) -> Row:
    """Add the times and the failing gates of the package in `folder`; with `strict` these make the item fail."""
    steps = (record_of(folder) or {}).get("run", {}).get("steps", [])
    times = {
        "compute_s": sum(step.get("duration_s", 0.0) for step in steps),
        "cpu_s": sum(step.get("cpu_s", 0.0) for step in steps),
        "gpu_s": sum(step["duration_s"] for step in steps if step.get("machine", {}).get("gpu")),
    }
    failing = failing_gates(folder)
    row = row.model_copy(update={"failing": failing, **{name: round(time, 3) for name, time in times.items()}})
    if not strict or not failing:
        return row
    message = f"not accepted: {', '.join(failing)}; see {folder / 'report.html'} for remedies"
    return row.model_copy(update={"status": "failed", "kind": NOT_ACCEPTED, "message": message})


def _index(out: Path, rows: list[Row], counts: dict[str, int]) -> str:
    """Render a page with an animated picture of every asset: failed ones first, then those that are not accepted."""
    ordered = sorted(rows, key=lambda row: (row.status != "failed", not row.failing, row.item))
    title = ", ".join(f"{number} {status}" for status, number in counts.items() if number)
    if refused := sum(bool(row.failing) for row in rows):
        title += f"; {refused} not accepted"
    return render("index.html", title=title, rows=ordered, quote=quote, picture=partial(_picture, out))


def _csv(items: list[dict[str, Any]]) -> str:
    table = io.StringIO()
    writer = csv.DictWriter(table, CSV_COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    rows = (item | {"failing": " ".join(item["failing"] or ())} for item in items)
    writer.writerows({column: csv_cell(value) for column, value in row.items()} for row in rows)
    return table.getvalue()


def _picture(out: Path, item: str) -> str:
    """Return the file name of a package's picture; empty if it has none."""
    return next((name for name in ("preview.webp", "contact_sheet.png") if (out / item / name).is_file()), "")
