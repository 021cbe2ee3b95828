"""Choice of where the items of a catalog run: threads, a Dask cluster, or flow runs of a deployment."""

import os
from typing import Literal, NamedTuple

from dg4d_lib.errors import BadInput

VARIABLE = "DG4D_RUNNER"
GRAMMAR = "local, dask://HOST:PORT, deployment, or deployment:POOL"


class Where(NamedTuple):
    """Place where items run.

    Attributes:
        kind: threads of this process, workers of a Dask cluster, or workers of a work pool.
        address: scheduler of the cluster, or name of the pool; empty: the only pool that takes items.
    """

    kind: Literal["local", "dask", "deployment"]
    address: str = ""


def parse_where(given: str = "") -> Where:
    """Parse `local`, `dask`, `dask://HOST:PORT`, `deployment` or `deployment:POOL`.

    Args:
        given: empty: what `$DG4D_RUNNER` says, else `local`; `dask` alone: the scheduler that `$DG4D_RUNNER` names.

    Raises:
        BadInput: it is something else.
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
    raise BadInput(f"{source} is {text!r}; items run where one of these says: {GRAMMAR}")
