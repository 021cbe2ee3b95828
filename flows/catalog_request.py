"""Request of a catalog, and conversion of its items to jobs."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from pydantic import Field

from dg4d_lib.errors import DG4DError
from flows import home
from flows.engine.output_lock import is_up_to_date
from flows.formatting.escaping import visible
from flows.inputs import naming
from flows.inputs.conversion_job import ConversionJob
from flows.inputs.manifest import Item, admitted, items_of, only_commercial
from flows.inputs.places import parse_where
from flows.packages.publish import check_folder
from flows.packages.summary import Row, with_verdict
from steps.contract import Frozen

ITEMS_IN_FLIGHT = 16  # of a deployment; pool and workers may allow fewer


class CatalogRequest(Frozen):
    """Request for a catalog.

    Attributes:
        inputs: folder, pattern, s3://BUCKET/PREFIX, or manifest.
        out: folder of the packages; created if missing.
        profile: profile of items that do not name one.
        changes: settings that differ from the profile.
        seed: seed of items that do not have one.
        workers: items at a time.
        where: place where items run; see `flows.inputs.places.parse_where`.
        commercial_only: refuse weights whose license forbids commercial use.
        strict: an asset that fails a quality gate is a failure, and ends the batch.
        root: folder of a manifest's files; None: the manifest's own.
        price_per_hour: price of the machine in any currency, for the summary.
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
            allow: raises BadInput for an item that must not be converted here; the item counts as failed.

        Raises:
            BadInput: the batch as a whole cannot be used.
        """
        items = items_of(self.inputs, self.out, self.profile, self.changes, self.seed, self.root)
        items = admitted(items, allow) if allow else items
        return only_commercial(items) if self.commercial_only else items


def default_workers(where: str) -> int:
    """Return the default number of items at a time: 1 on this machine, 16 for a deployment.

    Raises:
        BadInput: `where` is invalid.
    """
    return ITEMS_IN_FLIGHT if parse_where(where).kind == "deployment" else 1


def ready(item: Item, out: Path, strict: bool) -> ConversionJob | Row:
    """Return the job of an item, or its row if it is unchanged or invalid."""
    row = Row(item=item.name, source=visible(item.request.source_name) if item.request else "", status="unchanged")
    failed = row.model_copy(update={"status": "failed"})
    try:
        naming.check_not_reserved(item.name)
        if item.request is not None:
            item.request.check_names()  # before a file is downloaded under this name
        with item.fetch() as request:
            request.check()
            check_folder(out / item.name)
            job = request.to_job(home.store())
        return with_verdict(row, out / item.name, strict) if is_up_to_date(out / item.name, job.digest()) else job
    except DG4DError as error:
        return failed.model_copy(update={"kind": type(error).__name__, "message": visible(str(error))})
    except Exception as error:  # must not stop the other items
        message = f"{type(error).__name__}: {visible(str(error))}"
        return failed.model_copy(update={"kind": "Crashed", "message": message})
