"""Opening of stores by address; obstore is imported only for object stores."""

import functools
import os
from pathlib import Path
from urllib.parse import urlsplit

from dg4d_lib.errors import BackendUnavailable, BadInput
from steps.store.artifact_store import ArtifactStore
from steps.store.files import home

PATIENCE_S = 120.0  # seconds for which a request without an answer is repeated


def open_store(address: str | Path | None = None, patience_s: float | None = None) -> ArtifactStore:
    """Open the store at an address: a folder, or `s3://BUCKET/PREFIX` with the usual AWS_* variables.

    Args:
        address: default: `$DG4D_STORE`, else the folder `store` under the home folder.
        patience_s: seconds for which requests to an object store are repeated; default: `PATIENCE_S`.

    Raises:
        BadInput: the address has another form.
        BackendUnavailable: the library for object stores is not installed.
    """
    given = str(address or os.environ.get("DG4D_STORE") or home() / "store")
    return _opened(given, home() / "copies", PATIENCE_S if patience_s is None else patience_s)


@functools.cache
def _opened(given: str, copies: Path, patience_s: float) -> ArtifactStore:
    """Open a store once per process: it keeps connections and remembers verified files."""
    if "://" not in given:
        return ArtifactStore(Path(given).expanduser())
    parts = urlsplit(given)
    if parts.scheme != "s3" or not parts.netloc:
        raise BadInput(f"the store {given!r} is neither a folder nor of the form s3://BUCKET/PREFIX; set $DG4D_STORE")
    try:
        from steps.store.bucket import open_bucket  # noqa: PLC0415 - an optional extra
    except ModuleNotFoundError as error:
        raise BackendUnavailable(f"{given} needs obstore, which is not installed; run `make setup`") from error
    return open_bucket(given, copies, patience_s)
