"""Conversion of a folder, a pattern, an object store or a manifest; behind `dg4d batch`."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from flows import convert
from flows.catalog_request import CatalogRequest, ready
from flows.commands import terminal
from flows.engine import resources
from flows.exit_status import exit_status_of
from flows.inputs.manifest import Item
from flows.inputs.places import parse_where
from flows.packages.publish import check_writable
from flows.packages.summary import BatchProgress, Row, Writer

if TYPE_CHECKING:
    from rich.console import Console


def batch(request: CatalogRequest, console: "Console", allow: Callable[[Item], None] | None = None) -> list[Row]:
    """Convert every item of a catalog that is not finished; return a result for each, in order of conversion.

    Writes a folder per item, summary.json, summary.csv and index.html. Items are prepared one ahead of the running
    ones, so that a batch of thousands starts at once.

    Args:
        request: the catalog.
        console: for progress.
        allow: raises BadInput for an item that may not be made here, which then counts as failed.

    Raises:
        BadInput: the batch as a whole cannot be used, or `out` cannot be written.
        BackendUnavailable: something that all items need is missing.
        KeyboardInterrupt: the user stopped it; finished items stay, and the summary lists the others as skipped.
    """
    out = request.out
    parse_where(request.where)
    items = request.items(allow)
    resources.cpus(), resources.gpus(), resources.slot_folder()  # validate $DG4D_CPUS, $DG4D_GPUS and $DG4D_SLOTS first
    check_writable(out)
    out.mkdir(parents=True, exist_ok=True)
    writer = Writer(out, request.commercial_only, request.price_per_hour)
    with terminal.batch_shown(console, [item.name for item in items]) as table:

        def show(row: Row) -> None:
            table.show(row, console)
            writer.write_sometimes(list(progress.rows.values()), progress.seconds)

        progress = BatchProgress(len(items), show)
        try:
            _convert(request, items, progress)
        finally:
            stopped = (Row(item=item.name, status="skipped", message="not started, or stopped") for item in items)
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
        console.print("nothing to do: every item is up to date")
    console.print(f"{sum(row.has_package for row in rows)} of {len(rows)} items are in {out}", markup=False)
    console.print(f"overview: {out / 'index.html'}", markup=False)
    if not failed:
        return 0
    return exit_status_of(row.kind for row in rows)


def _convert(request: CatalogRequest, items: list[Item], progress: BatchProgress) -> None:
    """Skip finished items without a server, then run the catalog from the first unfinished one."""
    for item in items:
        first = ready(item, request.out, request.strict)
        if isinstance(first, Row):
            progress.settle(first)
            continue
        if parse_where(request.where).kind == "local":
            convert.prepare(first)
        convert.connect()
        from flows.catalog import run_catalog

        run_catalog(request, f"{Path(request.inputs).name}: {len(items)} items", progress, items)
        return
