"""Choice of the machines that convert the items of a catalog: threads, a Dask cluster, or a Prefect deployment."""

import os
from typing import Literal, NamedTuple

from dg4d_lib.errors import BadInput

VARIABLE = "DG4D_RUNNER"
GRAMMAR = "local, dask://HOST:PORT, deployment, or deployment:POOL"


class Where(NamedTuple):
    """Choice of where items run.

    Attributes:
        kind: threads of this process, workers of a Dask cluster, or workers of a work pool.
        address: scheduler of the cluster, or name of the pool; empty: the only pool that takes items.
    """

    kind: Literal["local", "dask", "deployment"]
    address: str = ""


def parse_where(given: str = "") -> Where:
    """Parse `local`, `dask`, `dask://HOST:PORT`, `deployment` or `deployment:POOL`.

    Args:
        given: empty: `$DG4D_RUNNER`, else `local`; `dask` alone: the scheduler in `$DG4D_RUNNER`.

    Raises:
        BadInput: the text is not one of these.
    """
    preset = os.environ.get(VARIABLE, "")
    text, source = (given, "--where") if given else (preset, f"${VARIABLE}")
    if text == "dask" and preset.startswith("dask://"):
        text = preset
    if text in {"", "local"}:
        return Where("local")
    if text == "deployment":
        return Where("deployment")
    if text.startswith("deployment:") and (pool := text.removeprefix("deployment:").strip()):
        return Where("deployment", pool)
    if text.startswith("dask://") and (address := text.removeprefix("dask://")):
        return Where("dask", address)
    raise BadInput(f"{source} is {text!r}; use one of: {GRAMMAR}")
