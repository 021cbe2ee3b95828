"""How a run looks on a terminal, and in a log file where there is none."""

import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from flows.engine.events import StepEvent, listening
from flows.formatting.escaping import visible
from flows.formatting.numbers import format_number, format_size

if TYPE_CHECKING:
    from flows.inputs.conversion_job import ConversionJob

Result = TypeVar("Result")

LINE_EVERY_S = 10.0  # between two lines about one step, where there is no terminal
WIDE = 130  # columns, from which all values of a step fit beside its bar
ROWS_SHOWN = 30  # of a batch
SHORT_S = 0.5  # waiting that is not worth a word
COUNTED = 1  # totals up to this say nothing as a fraction


def console(stderr: bool = False) -> Console:
    """Where people read: standard output, or standard error where that is for machines."""
    stream = sys.stderr if stderr else sys.stdout
    return _Terminal(stderr=stderr, highlight=False, soft_wrap=not stream.isatty())


class _Terminal(Console):
    """A console that writes out what a terminal would obey, in every text that is printed."""

    def print(self, *objects: Any, **options: Any) -> None:
        super().print(*(visible(one) if isinstance(one, str) else one for one in objects), **options)


def with_steps(job: "ConversionJob", out: Console, work: Callable[[], Result]) -> Result:
    """What `work` gives, which runs a flow of this job, with its steps on the terminal."""
    from flows.convert import connect, prepare, save_pictures
    from flows.step_errors import StepBadInput

    with out.status("starting") if out.is_terminal else nullcontext():
        prepare(job)
        connect()
    try:
        with steps_shown(out):
            return work()
    except StepBadInput as error:  # a step knows files by their content, the user by their names
        raise StepBadInput(error.step, f"{job.source_name}: {error.message}", error.pictures) from error
    except Exception as error:
        for path in save_pictures(job, error):
            sys.stderr.write(f"the last good state: {path}\n")
        raise


@contextmanager
def steps_shown(out: Console) -> Iterator[None]:
    """Show every step while the block runs: bars on a terminal, lines elsewhere."""
    if out.is_terminal:
        bars = StepBars(out)
        with bars.progress, listening(bars), listening(Remarks(out)):
            yield
    else:
        with listening(StepLines(out)):
            yield


class StepBars:
    """A bar per step: how far, the current numbers, the time."""

    def __init__(self, out: Console) -> None:
        self.progress = Progress(
            SpinnerColumn(finished_text="[green]✓"),
            TextColumn("{task.description:<22}"),
            BarColumn(bar_width=28 if out.width >= WIDE else 14),
            TimeElapsedColumn(),
            TextColumn("[dim]{task.fields[numbers]}"),
            console=out,
        )
        self._bars: dict[str, TaskID] = {}
        self._values = None if out.width >= WIDE else 1  # a narrow terminal has room for the loss

    def __call__(self, event: StepEvent) -> None:
        """Show an event."""
        if event.step not in self._bars:
            self._bars[event.step] = self.progress.add_task(plain(event.step), total=None, numbers="")
        bar = self._bars[event.step]
        match event.kind:
            case "progress":
                text = numbers(event, self._values)
                self.progress.update(bar, completed=event.done, total=max(event.total, 1), numbers=text)
            case "note":
                self.progress.update(bar, numbers=plain(event.text))
            case "finished":
                self.progress.update(bar, total=1, completed=1, numbers="cached" if event.cached else "")
            case "failed":
                self.progress.update(bar, description=f"[red]{event.step}", numbers="failed")
                self.progress.stop_task(bar)
            case _:
                pass


class Remarks:
    """Lines above bars and tables, which stay."""

    def __init__(self, out: Console, with_item: bool = False) -> None:
        self._out, self._with_item = out, with_item

    def __call__(self, event: StepEvent) -> None:
        """Print a remark."""
        if event.kind == "remark":
            name = f"{event.item}: {event.step}" if self._with_item else event.step
            self._out.print(f"{name}: {event.text}", markup=False, soft_wrap=True)


class StepLines:
    """A line when a step starts, every few seconds, and when it ends."""

    def __init__(self, out: Console, with_item: bool = False) -> None:
        self._out, self._with_item = out, with_item
        self._last: dict[tuple[str, str], float] = {}
        self._lock = threading.Lock()

    def __call__(self, event: StepEvent) -> None:
        """Print an event, unless there was a line a moment ago."""
        with self._lock:
            key = event.item, event.step
            now = time.monotonic()
            if event.kind == "progress" and now - self._last.get(key, now - LINE_EVERY_S) < LINE_EVERY_S:
                return
            self._last[key] = now
            match event.kind:
                case "started":
                    what = "started"
                case "progress":
                    what = numbers(event)
                case "note" | "remark":
                    what = event.text
                case "finished":
                    what = "cached" if event.cached else _took(event)
                case "failed":
                    what = f"failed after {event.seconds:.1f} s"
            name = f"{event.item}: {event.step}" if self._with_item else event.step
            self._out.print(f"{name}: {what}", markup=False)


def _took(event: StepEvent) -> str:
    """Return how long a step took, without the time in which it waited for its turn."""
    waiting = f" after {event.waited_s:.1f} s of waiting" if event.waited_s >= SHORT_S else ""
    return f"done in {event.seconds - event.waited_s:.1f} s{waiting}"


class BatchTable:
    """A table with a row per item, alive while the batch runs."""

    def __init__(self, items: list[str]) -> None:
        self.status: dict[str, str] = dict.fromkeys(items, "waiting")
        self._doing: dict[str, str] = {}
        self._since: dict[str, float] = {}
        self._took: dict[str, float] = {}

    def __call__(self, event: StepEvent) -> None:
        """Note what an item is doing."""
        if event.item not in self.status or event.kind == "remark":
            return
        self._since.setdefault(event.item, time.monotonic())
        self._took.pop(event.item, None)  # it may be tried again
        self.status[event.item] = "running"
        detail = numbers(event) if event.kind == "progress" else event.text or event.kind
        self._doing[event.item] = f"{event.step}: {detail}"

    def settle(self, item: str, status: str, message: str) -> None:
        """An item ended."""
        self.status[item], self._doing[item] = status, message
        self._took[item] = time.monotonic() - self._since.get(item, time.monotonic())

    def __rich__(self) -> Table:
        """The table as it is; long batches show what is running and what failed last."""
        done = sum(status in INK and status not in {"waiting", "running"} for status in self.status.values())
        table = Table(title=f"{done} of {len(self.status)}", title_justify="left", expand=False)
        for heading in ("item", "status", "time", "what"):
            table.add_column(heading, overflow="ellipsis", no_wrap=True, max_width=72)
        shown = list(self.status)
        if len(shown) > ROWS_SHOWN:
            running = [item for item, status in self.status.items() if status == "running"]
            failed = [item for item, status in self.status.items() if status == "failed"]
            shown = [*running, *failed[-max(ROWS_SHOWN - len(running), 1) :]]
        for item in shown:
            status = self.status[item]
            took = self._took.get(item, time.monotonic() - self._since[item] if item in self._since else 0.0)
            doing = plain(self._doing.get(item, ""))
            table.add_row(plain(item), f"[{INK[status]}]{status}", f"{took:.0f} s" if took else "", doing)
        return table


INK = {"waiting": "dim", "skipped": "dim", "running": "cyan", "done": "green", "unchanged": "blue", "failed": "red"}


@contextmanager
def batch_shown(out: Console, items: list[str]) -> Iterator[BatchTable]:
    """Show a batch while the block runs: a live table on a terminal, lines elsewhere."""
    table = BatchTable(items)
    if out.is_terminal:
        with Live(table, console=out, refresh_per_second=4), listening(table), listening(Remarks(out, with_item=True)):
            yield table
    else:
        with listening(StepLines(out, with_item=True)):
            yield table


def numbers(event: StepEvent, most: int | None = None) -> str:
    """How far a step is, and its current values, at most the first `most` of them."""
    parts = [f"{event.done}/{event.total}"] if event.total > COUNTED else []
    return "  ".join([*parts, *(f"{name} {format_number(value)}" for name, value in list(event.values.items())[:most])])


def plain(text: str) -> str:
    """Return text for a place in which rich reads markup, so that it is shown letter by letter."""
    return escape(visible(text))


def tell_where(out: Console, folder: Path, sizes: dict[str, int]) -> None:
    """Everything in a package with its size."""
    table = Table(title=plain(str(folder)), title_justify="left", show_header=False, box=None, title_style="bold")
    table.add_column()
    table.add_column(justify="right")
    groups: dict[str, tuple[int, int]] = {}
    for name, size in sizes.items():
        group = f"{name.partition('/')[0]}/" if "/" in name else name
        count, total = groups.get(group, (0, 0))
        groups[group] = count + 1, total + size
    for group, (count, total) in groups.items():
        table.add_row(plain(group) + (f" ({_files(count)})" if group.endswith("/") else ""), format_size(total))
    out.print(table)


def tell_rows(out: Console, rows: Iterable[tuple[str, str, str]]) -> None:
    """What, how it is, and why, a line each, in columns."""
    lines = list(rows)
    widths = [max((len(line[column]) for line in lines), default=0) for column in (0, 1)]
    for what, state, why in lines:
        out.print(f"{what:<{widths[0]}}  {state:<{widths[1]}}  {why}".rstrip(), markup=False)


def _files(count: int) -> str:
    return "1 file" if count == 1 else f"{count} files"
