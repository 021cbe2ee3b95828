"""What lies beside the packages of a batch: `summary.json` and `summary.csv` for programs, `index.html` for people."""

import csv
import io
import json
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args
from urllib.parse import quote

from pydantic import BaseModel

from flows.formatting.escaping import cell
from flows.inputs.package_record import record_of
from flows.packages.acceptance import failing_in
from flows.packages.html_pages import render
from steps.store.files import write_atomically

Status = Literal["done", "unchanged", "failed", "skipped"]
NOT_ACCEPTED = "NotAccepted"  # the kind of failure of an item that was made, but fails a gate in a strict batch
BAD_INPUT = {"BadInput", "StepBadInput", "BackendUnavailable"}  # kinds for which what was given is to blame
CSV_COLUMNS = (
    "item", "source", "status", "kind", "message", "attempts", "wall_s", "compute_s", "cpu_s", "gpu_s", "cost",
    "failing",
)  # fmt: skip
WRITE_EVERY_S = 5.0  # at most so often while a batch runs
WRITING_SHARE = 0.05  # of the time of a batch, at most, for writing the summary


class Row(BaseModel):
    """What became of one item.

    Attributes:
        item: its name, and its folder below that of the batch.
        source: what people call what it was made of.
        status: what became of it; `unchanged` was made before.
        kind: of its failure.
        message: for people.
        attempts: how often it was begun in this batch.
        wall_s: seconds on the clock in this batch, with waiting.
        compute_s: seconds in which its steps were computed, now or before, added up.
        cpu_s: of all cores, in these steps.
        gpu_s: of `compute_s`, in steps that used a GPU.
        pictures: that explain a failure.
        failing: gates; None where there is no verdict.
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
    def made(self) -> bool:
        """Whether there is a package, be it accepted or not."""
        return self.status in {"done", "unchanged"} or self.kind == NOT_ACCEPTED


class BatchProgress:
    """Outcomes of the items of a batch so far; safe to update from several threads.

    Args:
        total: how many items there are.
        listener: called with every new row.
    """

    def __init__(self, total: int, listener: Callable[[Row], None] = lambda row: None) -> None:
        self.total = total
        self.rows: dict[str, Row] = {}
        self._listener = listener
        self._mutex = threading.RLock()  # a listener may ask
        self._begun = time.monotonic()

    def settle(self, row: Row) -> None:
        """Note what became of an item; the last word counts."""
        with self._mutex:
            self.rows[row.item] = row
            self._listener(row)

    @property
    def seconds(self) -> float:
        """Since the batch began."""
        return time.monotonic() - self._begun

    @property
    def refused(self) -> str:
        """An item that a strict batch does not accept; empty if there is none."""
        with self._mutex:
            return next((row.item for row in self.rows.values() if row.kind == NOT_ACCEPTED), "")

    @property
    def share(self) -> float:
        """Of the items that are settled, from 0 to 1."""
        return len(self.rows) / max(self.total, 1)

    def line(self) -> str:
        """How far the batch is: items, failures, rate, the time that is left by the rate so far."""
        with self._mutex:
            rows = list(self.rows.values())
        worked = [row for row in rows if row.status != "unchanged"]
        parts = [f"{len(rows)} of {self.total} items", f"{sum(row.status == 'failed' for row in rows)} failed"]
        if worked:
            rate = len(worked) / max(self.seconds, 1e-9)
            parts.append(f"{3600 * rate:.0f} an hour" if rate < 1 else f"{rate:.1f} a second")
            if left := self.total - len(rows):
                parts.append(f"about {_duration(left / rate)} left")
        return ", ".join(parts)


class Writer:
    """Writes the summary of a batch now and then while it runs, and whole at its end.

    Args:
        out: the folder of the batch.
        commercial_only: whether weights had to allow commercial use.
        price_per_hour: of the machine, in any currency; None where nobody asks.
    """

    def __init__(self, out: Path, commercial_only: bool = False, price_per_hour: float | None = None) -> None:
        self._out, self._commercial_only, self._price = out, commercial_only, price_per_hour
        self._next = 0.0

    def write_sometimes(self, rows: list[Row], seconds: float) -> None:
        """As `write`, unless that was a moment ago; all writing takes a small share of the time of a batch."""
        start = time.monotonic()
        if start >= self._next:
            self.write(rows, seconds)
            took = time.monotonic() - start
            self._next = start + max(WRITE_EVERY_S, took / WRITING_SHARE)

    def write(self, rows: list[Row], seconds: float) -> None:
        """Write what is known.

        Args:
            rows: of the items so far.
            seconds: since the batch began.

        Raises:
            DiskFull: there is no room; what was there stays.
        """
        counts = {status: sum(row.status == status for row in rows) for status in get_args(Status)}
        items = [row.model_dump(mode="json") | {"cost": self._cost(row.compute_s)} for row in rows]
        totals: dict[str, Any] = {
            name: round(sum(getattr(row, name) for row in rows), 3) for name in ("compute_s", "cpu_s", "gpu_s")
        }
        summary = {
            "counts": counts,
            "made": sum(row.made for row in rows),
            "not_accepted": [row.item for row in rows if row.failing],
            "commercial_only": self._commercial_only,
            "wall_s": round(seconds, 1),
            "totals": totals | {"cost": self._cost(totals["compute_s"])},
            "price_per_hour": self._price,
            "items": items,
        }
        write_atomically(self._out / "summary.json", json.dumps(summary, indent=1, ensure_ascii=False) + "\n")
        write_atomically(self._out / "summary.csv", _csv(items))
        write_atomically(self._out / "index.html", index(self._out, rows, counts))

    def _cost(self, compute_s: float) -> float | None:
        """What computing so long costs, were the machine to do nothing else."""
        return None if self._price is None else round(self._price * compute_s / 3600, 6)


def with_costs(row: Row, folder: Path) -> Row:
    """The row of an item whose package lies in `folder`, with what its steps took, by their records."""
    steps = (record_of(folder) or {}).get("run", {}).get("steps", [])
    return row.model_copy(
        update={
            "compute_s": round(sum(step.get("duration_s", 0.0) for step in steps), 3),
            "cpu_s": round(sum(step.get("cpu_s", 0.0) for step in steps), 3),
            "gpu_s": round(sum(step["duration_s"] for step in steps if step.get("machine", {}).get("gpu")), 3),
        }
    )


def judged(row: Row, folder: Path, strict: bool) -> Row:
    """The row of an item whose package lies in `folder`, with what the gates say; with `strict` a verdict counts."""
    failing = failing_in(folder)
    row = with_costs(row, folder).model_copy(update={"failing": failing})
    if not strict or not failing:
        return row
    message = f"not accepted: {', '.join(failing)}; {folder / 'report.html'} says what to do"
    return row.model_copy(update={"status": "failed", "kind": NOT_ACCEPTED, "message": message})


def index(out: Path, rows: list[Row], counts: dict[str, int]) -> str:
    """A page with a moving picture of every asset; the failed ones first, then those that are not accepted."""
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
    writer.writerows({column: cell(value) for column, value in row.items()} for row in rows)
    return table.getvalue()


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60)
    if minutes < 1:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60:02d} min"


def _picture(out: Path, item: str) -> str:
    """Return the name of the picture of a package; empty if it has none."""
    return next((name for name in ("preview.webp", "contact_sheet.png") if (out / item / name).is_file()), "")
