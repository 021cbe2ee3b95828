"""Progress of runs: live on a terminal, as lines in a log file."""

import errno
import os
import shlex
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from flows.engine.events import StepEvent, listening
from flows.engine.schedule import format_left
from flows.formatting.escaping import visible
from flows.formatting.numbers import format_number, format_size

if TYPE_CHECKING:
    from flows.engine.schedule import Schedule
    from flows.inputs.conversion_job import ConversionJob
    from flows.packages.summary import Row

Result = TypeVar("Result")

LINE_EVERY_S = 10.0  # between two progress lines of a step, without a terminal
WIDE = 130  # columns from which all values of a step fit beside its bar
ROWS_SHOWN = 30  # of a batch
SHORT_S = 0.5  # waiting times below this are not shown
UNWRAPPED = 10_000  # columns without a terminal: tables are not wrapped for the program that reads them
COUNTED = 1  # totals up to this are not shown as a fraction


def console(stderr: bool = False) -> Console:
    """Return a console on standard output, or on standard error if programs read standard output."""
    stream = sys.stderr if stderr else sys.stdout
    wide = not stream.isatty()
    return _Terminal(stderr=stderr, highlight=False, soft_wrap=wide, width=UNWRAPPED if wide else None)


class _Terminal(Console):
    """Console that escapes control characters in all printed text, and leaves a closed pipe to `exit_on_error`."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))

    def print(self, *objects: Any, **options: Any) -> None:
        super().print(*(visible(one) if isinstance(one, str) else one for one in objects), **options)


def run_with_progress(
    job: "ConversionJob", out: Console, work: Callable[[], Result], steps: Sequence[str] = ()
) -> Result:
    """Return the result of `work`, which runs the flow of a job, and show its steps.

    Args:
        job: job of the flow.
        out: console.
        work: runs the flow.
        steps: names of the steps that it runs; default: those of a whole conversion, whose durations are remembered.
    """
    from flows.convert import save_pictures
    from flows.engine.schedule import Schedule, keep_durations, load_durations
    from flows.stages import planned_steps
    from flows.step_errors import StepBadInput

    _connect(job, out)
    schedule = Schedule(steps or planned_steps(job), load_durations(job.profile))
    try:
        with steps_shown(out, schedule):
            result = work()
        if not steps:
            keep_durations(job.profile, schedule.durations())
        return result
    except StepBadInput as error:  # a step knows no file names
        raise StepBadInput(error.step, f"{job.source_name}: {error.message}", error.pictures) from error
    except Exception as error:
        for path in save_pictures(job, error):
            sys.stderr.write(f"last valid state: {path}\n")
        raise


def _connect(job: "ConversionJob", out: Console) -> None:
    """Connect to the server, and show the stages of its start."""
    from flows.convert import STARTING, announcing, connect, prepare

    def print_start(stage: str) -> None:
        if stage.startswith(STARTING):
            out.print(stage, markup=False)

    status = out.status("starting the processes of the steps") if out.is_terminal else None
    with status or nullcontext(), announcing(status.update if status else print_start):
        prepare(job)
        connect()


@contextmanager
def steps_shown(out: Console, schedule: "Schedule | None" = None) -> Iterator[None]:
    """Show the steps that run in the block: bars on a terminal, lines elsewhere.

    Args:
        out: console.
        schedule: of the conversion, for the number of the step and the time left; None: unknown.
    """
    noting = listening(schedule.note) if schedule is not None else nullcontext()
    if out.is_terminal:
        bars = StepBars(out, schedule)
        with bars.progress, noting, listening(bars), listening(Remarks(out)):
            yield
    else:
        with noting, listening(StepLines(out, schedule=schedule)):
            yield


class StepBars:
    """Progress bar per step, with values and time."""

    def __init__(self, out: Console, schedule: "Schedule | None" = None) -> None:
        self._schedule = schedule
        self.progress = Progress(
            SpinnerColumn(finished_text="[green]✓"),
            TextColumn("{task.description:<22}"),
            BarColumn(bar_width=28 if out.width >= WIDE else 14),
            TimeElapsedColumn(),
            TextColumn("[dim]{task.fields[numbers]}"),
            console=out,
        )
        self._bars: dict[str, TaskID] = {}
        self._values = None if out.width >= WIDE else 1  # a narrow terminal has room for the loss only
        self._overall = self.progress.add_task("starting", total=len(schedule.steps), numbers="") if schedule else None

    def __call__(self, event: StepEvent) -> None:
        """Show an event."""
        if self._overall is not None and self._schedule is not None:
            if event.kind == "started" and (place := self._schedule.position(event.step)):
                self.progress.update(self._overall, description=place)
            left = format_left(self._schedule.seconds_left())
            self.progress.update(self._overall, completed=self._schedule.finished, numbers=left)
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
    """Permanent lines above bars and tables."""

    def __init__(self, out: Console, with_item: bool = False) -> None:
        self._out, self._with_item = out, with_item

    def __call__(self, event: StepEvent) -> None:
        """Print a remark."""
        if event.kind == "remark":
            name = f"{event.item}: {event.step}" if self._with_item else event.step
            self._out.print(f"{name}: {event.text}", markup=False, soft_wrap=True)


class StepLines:
    """Line when a step starts, every few seconds, and when it ends."""

    def __init__(self, out: Console, with_item: bool = False, schedule: "Schedule | None" = None) -> None:
        self._out, self._with_item, self._schedule = out, with_item, schedule
        self._last: dict[tuple[str, str], float] = {}
        self._lock = threading.Lock()

    def __call__(self, event: StepEvent) -> None:
        """Print an event, but progress only every `LINE_EVERY_S` seconds."""
        with self._lock:
            key = event.item, event.step
            now = time.monotonic()
            if event.kind == "progress" and now - self._last.get(key, now - LINE_EVERY_S) < LINE_EVERY_S:
                return
            self._last[key] = now
            match event.kind:
                case "started":
                    what = ", ".join(["started", *self._position(event, with_number=True)])
                case "progress":
                    what = ", ".join([numbers(event), *self._position(event)])
                case "note" | "remark":
                    what = event.text
                case "finished":
                    what = "cached" if event.cached else _took(event)
                case "failed":
                    what = f"failed after {event.seconds:.1f} s"
            name = f"{event.item}: {event.step}" if self._with_item else event.step
            self._out.print(f"{name}: {what}", markup=False)

    def _position(self, event: StepEvent, with_number: bool = False) -> list[str]:
        """Return the number of the step and the time left, as far as they are known."""
        if self._schedule is None:
            return []
        number = self._schedule.position(event.step) if with_number else ""
        return list(filter(None, [number, format_left(self._schedule.seconds_left())]))


def _took(event: StepEvent) -> str:
    """Return the time that a step took, with waiting apart."""
    waiting = f" after {event.waited_s:.1f} s of waiting" if event.waited_s >= SHORT_S else ""
    return f"done in {event.seconds - event.waited_s:.1f} s{waiting}"


class BatchTable:
    """Live table of a batch with a row per item."""

    def __init__(self, items: list[str]) -> None:
        self.status: dict[str, str] = dict.fromkeys(items, "waiting")
        self._doing: dict[str, str] = {}
        self._since: dict[str, float] = {}
        self._took: dict[str, float] = {}

    def __call__(self, event: StepEvent) -> None:
        """Update the activity of an item."""
        if event.item not in self.status or event.kind == "remark":
            return
        self._since.setdefault(event.item, time.monotonic())
        self._took.pop(event.item, None)  # it may be a second attempt
        self.status[event.item] = "running"
        detail = numbers(event) if event.kind == "progress" else event.text or event.kind
        self._doing[event.item] = f"{event.step}: {detail}"

    def settle(self, item: str, status: str, message: str) -> None:
        """Record the end of an item."""
        self.status[item], self._doing[item] = status, message
        self._took[item] = time.monotonic() - self._since.get(item, time.monotonic())

    def show(self, row: "Row", out: Console) -> None:
        """Record the result of an item, and print it where there is no terminal."""
        self.settle(row.item, row.status, row.message)
        if not out.is_terminal:
            out.print(f"{row.item}: {row.status} {row.message}".rstrip(), markup=False)

    def __rich__(self) -> Table:
        """Return the table; in long batches only running items and the latest failures."""
        done = sum(status in INK and status not in {"waiting", "running"} for status in self.status.values())
        table = Table(title=f"{done} of {len(self.status)}", title_justify="left", expand=False)
        for heading in ("item", "status", "time", "activity"):
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
    """Show the batch that runs in the block: a live table on a terminal, lines elsewhere."""
    table = BatchTable(items)
    if out.is_terminal:
        with Live(table, console=out, refresh_per_second=4), listening(table), listening(Remarks(out, with_item=True)):
            yield table
    else:
        with listening(StepLines(out, with_item=True)):
            yield table


def numbers(event: StepEvent, most: int | None = None) -> str:
    """Return the progress of a step and its current values, at most `most` of them."""
    parts = [f"{event.done}/{event.total}"] if event.total > COUNTED else []
    return "  ".join([*parts, *(f"{name} {format_number(value)}" for name, value in list(event.values.items())[:most])])


def plain(text: str) -> str:
    """Escape text for rich markup and for terminals."""
    return escape(visible(text))


def print_package(out: Console, folder: Path, sizes: dict[str, int]) -> None:
    """Print the files and folders of a package with their sizes."""
    table = Table(title=plain(str(folder)), title_justify="left", show_header=False, box=None, title_style="bold")
    table.add_column()
    table.add_column(justify="right")
    groups: dict[str, tuple[int, int]] = {}
    for name, size in sizes.items():
        group = f"{name.partition('/')[0]}/" if "/" in name else name
        count, total = groups.get(group, (0, 0))
        groups[group] = count + 1, total + size
    for group, (count, total) in groups.items():
        files = f" ({count} file{'s' * (count != 1)})" if group.endswith("/") else ""
        table.add_row(plain(group) + files, format_size(total))
    out.print(table)


def print_next(out: Console, folder: Path) -> None:
    """Print the report of a package and the two ways to see the asset."""
    if (folder / "report.html").is_file():
        out.print(f"report: {folder / 'report.html'}", markup=False)
    if (folder / "viewer.html").is_file():
        command = shlex.join(["dg4d", "view", str(folder)])
        out.print(f"viewer: {folder / 'viewer.html'} (open it with `{command}`)", markup=False)


def print_tables(out: Console, tables: Iterable[tuple[str, Sequence[Mapping[str, str]]]]) -> None:
    """Print titled tables whose rows map headings to cells; the first column is text, the others are numbers."""
    for title, rows in tables:
        table = Table(title=plain(title), title_justify="left", title_style="bold", box=SIMPLE_HEAD)
        for number, heading in enumerate(rows[0] if rows else ()):
            table.add_column(plain(heading), justify="right" if number else "left", overflow="fold")
        for row in rows:
            table.add_row(*map(plain, row.values()))
        out.print(table)


def print_rows(out: Console, rows: Iterable[tuple[str, str, str]]) -> None:
    """Print name, state and detail in columns, a line each."""
    lines = list(rows)
    widths = [max((len(line[column]) for line in lines), default=0) for column in (0, 1)]
    for name, state, detail in lines:
        out.print(f"{name:<{widths[0]}}  {state:<{widths[1]}}  {detail}".rstrip(), markup=False)
