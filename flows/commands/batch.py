"""`dg4d batch`: many assets out of a folder, a pattern, an object store or a manifest; what is made is left alone."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from dg4d_lib.errors import DG4DError
from flows import home
from flows.commands import make, terminal
from flows.commands.endings import EXIT_BAD_INPUT, EXIT_FAILED
from flows.engine import resources
from flows.engine.runners import parse_where
from flows.formatting.escaping import visible
from flows.inputs import naming
from flows.inputs.manifest import Item, admitted, items_of, only_commercial
from flows.inputs.orders import Order
from flows.packages.publish import check_folder, check_writable, is_current
from flows.packages.summary import BAD_INPUT, Row, Tally, Writer, judged
from steps.contract import Frozen

if TYPE_CHECKING:
    from rich.console import Console

ITEMS_IN_FLIGHT = 16  # of a deployment; its pool and its workers may allow fewer


class CatalogRequest(Frozen):
    """Request for a catalog: what to make, where it goes, where items run.

    Attributes:
        inputs: a folder, a pattern, s3://BUCKET/PREFIX, or a manifest.
        out: folder of the packages; made if it is not there.
        profile: of items that do not name one.
        changes: of its knobs.
        seed: of items that do not have one.
        workers: items at a time.
        where: where items run, as `flows.engine.runners.parse_where` reads it.
        commercial_only: refuse weights whose license forbids commercial use.
        strict: an asset that a gate does not let pass is a failure, and ends the batch.
        root: where a manifest's files are; None: beside it.
        price_per_hour: of the machine, in any currency, for the summary.
    """

    inputs: str
    out: Path
    profile: str = "preview"
    changes: dict[str, Any] = Field({})
    seed: int = 0
    workers: int = 1
    where: str = ""
    commercial_only: bool = False
    strict: bool = False
    root: Path | None = None
    price_per_hour: float | None = None

    def items(self, allow: Callable[[Item], None] | None = None) -> list[Item]:
        """Return the items by priority and name.

        Args:
            allow: raises BadInput for an item that may not be made here; it becomes a failed one.

        Raises:
            BadInput: the batch as a whole cannot be used.
        """
        items = items_of(self.inputs, self.out, self.profile, self.changes, self.seed, self.root)
        items = admitted(items, allow) if allow else items
        return only_commercial(items) if self.commercial_only else items


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
            writer.write_sometimes(list(tally.rows.values()), tally.seconds)

        tally = Tally(len(items), show)
        try:
            _make_all(request, items, tally, connect, allow)
        finally:
            stopped = (Row(item=item.name, status="skipped", message="not begun, or stopped") for item in items)
            rows = [tally.rows.get(row.item, row) for row in stopped]
            writer.write(rows, tally.seconds)
    return rows


def default_workers(where: str) -> int:
    """Return how many items are made at a time where nobody says: on this machine one, by a deployment more.

    Raises:
        BadInput: `where` is no place for items.
    """
    return ITEMS_IN_FLIGHT if parse_where(where).kind == "deployment" else 1


def tell(rows: list[Row], out: Path, console: "Console") -> int:
    """Say how a batch ended; the exit status of the command."""
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
    tally: Tally,
    connect: Callable[[], None] | None,
    allow: Callable[[Item], None] | None,
) -> None:
    """Settle the items before the first that has to be made, which takes no server; then run the catalog."""
    for item in items:
        first = ready(item, request.out, request.strict)
        if isinstance(first, Row):
            tally.settle(first)
            continue
        if parse_where(request.where).kind == "local":
            make.prepare(first)
        (connect or make.connect)()
        from flows.catalog import run_catalog

        run_catalog(request, f"{Path(request.inputs).name}: {len(items)} items", tally, allow)
        return


def ready(item: Item, out: Path, strict: bool) -> Order | Row:
    """Return the order of an item, or what became of it already; whatever is wrong with it makes a row that failed."""
    row = Row(item=item.name, source=visible(item.wish.source_name) if item.wish else "", status="unchanged")
    failed = row.model_copy(update={"status": "failed"})
    try:
        naming.check_not_reserved(item.name)
        if item.wish is not None:
            item.wish.check_names()  # before a file of this name is fetched
        with item.here() as wish:
            wish.check()
            check_folder(out / item.name)
            order = wish.order(home.store())
        return judged(row, out / item.name, strict) if is_current(out / item.name, order.digest()) else order
    except DG4DError as error:
        return failed.model_copy(update={"kind": type(error).__name__, "message": visible(str(error))})
    except Exception as error:  # it is this item's own
        message = f"{type(error).__name__}: {visible(str(error))}"
        return failed.model_copy(update={"kind": "Crashed", "message": message})
