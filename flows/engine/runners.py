"""Task runners of the items of a catalog."""

from typing import Any

from prefect.task_runners import TaskRunner, ThreadPoolTaskRunner

from dg4d_lib.errors import BackendUnavailable
from flows.inputs.places import Where


def item_runner(where: Where, workers: int) -> TaskRunner[Any]:
    """Return the task runner of the items of a catalog.

    The workers of a Dask cluster have to see the same `$DG4D_HOME` and output folder, and be started with one thread
    each. An item of a deployment has a thread here that waits for its run.

    Args:
        where: parsed `--where` option.
        workers: number of threads.

    Raises:
        BackendUnavailable: prefect-dask is not installed.
    """
    if where.kind != "dask":
        return ThreadPoolTaskRunner(max_workers=workers)
    try:
        from prefect_dask.task_runners import DaskTaskRunner  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise BackendUnavailable("a Dask cluster needs prefect-dask; run `make setup`") from error
    return DaskTaskRunner(address=f"tcp://{where.address}")
