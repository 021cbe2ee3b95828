"""`dg4d batch`: many assets out of a folder, a pattern, an object store or a manifest; what is made is left alone."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from flows import convert
from flows.catalog_request import CatalogRequest, ready
from flows.commands import terminal
from flows.commands.endings import EXIT_BAD_INPUT, EXIT_FAILED
from flows.engine import resources
from flows.inputs.manifest import Item
from flows.inputs.places import parse_where
from flows.packages.publish import check_writable
from flows.packages.summary import BAD_INPUT, BatchProgress, Row, Writer

if TYPE_CHECKING:
    from rich.console import Console


def batch(
    request: CatalogRequest,
    console: "Console",
    connect: Callable[[], None] | None = None,
    allow: Callable[[Item], None] | None = None,
) -> list[Row]:
    """Make every item of a catalog that is not made yet; return a row for each, in the order in which they are made.

    OUT gets a folder per item, summary.json, summary.csv and index.html. Items are read and prepared one ahead of
    those at work, so that a batch of thousands begins at once.

    Args:
        request: the catalog.
        console: where to show progress.
        connect: finds a Prefect server, when the first item needs one; default: as every command does.
        allow: raises BadInput for an item that may not be made here; it becomes a failed one.

    Raises:
        BadInput: the batch as a whole cannot be used, or `out` cannot be written.
        BackendUnavailable: something that all of it needs is missing.
        KeyboardInterrupt: the user stopped it; what is done stays, and the summary says what was not.
    """
    out = request.out
    parse_where(request.where)
    items = request.items(allow)
    resources.cpus(), resources.gpus()  # wrong numbers are refused before any work
    check_writable(out)
    out.mkdir(parents=True, exist_ok=True)
    writer = Writer(out, request.commercial_only, request.price_per_hour)
    with terminal.batch_shown(console, [item.name for item in items]) as table:

        def show(row: Row) -> None:
            table.settle(row.item, row.status, row.message)
            if not console.is_terminal:
                console.print(f"{row.item}: {row.status} {row.message}".rstrip(), markup=False)
            writer.write_sometimes(list(progress.rows.values()), progress.seconds)

        progress = BatchProgress(len(items), show)
        try:
            _make_all(request, items, progress, connect, allow)
        finally:
            stopped = (Row(item=item.name, status="skipped", message="not begun, or stopped") for item in items)
            rows = [progress.rows.get(row.item, row) for row in stopped]
            writer.write(rows, progress.seconds)
    return rows


def print_summary(rows: list[Row], out: Path, console: "Console") -> int:
    """Print how a batch ended and return the exit status of the command."""
    failed = [row for row in rows if row.status == "failed"]
    for row in failed:
        console.print(f"failed: {row.item}: {row.message}", markup=False, style="red")
    for row in rows:
        if row.failing and row.status != "failed":
            console.print(f"not accepted: {row.item}: {', '.join(row.failing)}", markup=False, style="yellow")
    if all(row.status == "unchanged" for row in rows):
        console.print("nothing to do: every item was already done")
    console.print(f"{sum(row.made for row in rows)} of {len(rows)} items are in {out}", markup=False)
    console.print(f"overview: {out / 'index.html'}", markup=False)
    if not failed:
        return 0
    return EXIT_BAD_INPUT if all(row.kind in BAD_INPUT for row in rows) else EXIT_FAILED


def _make_all(
    request: CatalogRequest,
    items: list[Item],
    progress: BatchProgress,
    connect: Callable[[], None] | None,
    allow: Callable[[Item], None] | None,
) -> None:
    """Settle the items before the first that has to be made, which takes no server; then run the catalog."""
    for item in items:
        first = ready(item, request.out, request.strict)
        if isinstance(first, Row):
            progress.settle(first)
            continue
        if parse_where(request.where).kind == "local":
            convert.prepare(first)
        (connect or convert.connect)()
        from flows.catalog import run_catalog

        run_catalog(request, f"{Path(request.inputs).name}: {len(items)} items", progress, allow)
        return
