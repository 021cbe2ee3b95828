"""Where the items of a batch are made: in threads of this process, or by the workers of a Dask cluster."""

import os
from typing import Any

from prefect.task_runners import TaskRunner, ThreadPoolTaskRunner

from dg4d_lib.errors import BackendUnavailable, BadInput


def item_runner(workers: int) -> TaskRunner[Any]:
    """What `$DG4D_RUNNER` names: nothing, or `dask://HOST:PORT` of a scheduler.

    The workers of a cluster have to see the same `$DG4D_HOME` and output folder, and be started with one thread each.

    Args:
        workers: items at a time, of threads.

    Raises:
        BadInput: it names something else.
        BackendUnavailable: prefect-dask is not installed.
    """
    named = os.environ.get("DG4D_RUNNER", "")
    if not named:
        return ThreadPoolTaskRunner(max_workers=workers)
    kind, _, address = named.partition("://")
    if kind != "dask" or not address:
        raise BadInput(f"$DG4D_RUNNER is {named!r}; leave it out, or name the scheduler of a cluster: dask://HOST:PORT")
    try:
        from prefect_dask.task_runners import DaskTaskRunner  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise BackendUnavailable("$DG4D_RUNNER needs prefect-dask: pip install 'dg4d[dask]'") from error
    return DaskTaskRunner(address=f"tcp://{address}")
