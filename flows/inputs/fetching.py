"""A user's file from wherever its address says: a path, a web server, an object store."""

import http.client
import tempfile
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from urllib.parse import unquote, urlsplit

from dg4d_lib.errors import BadInput
from flows.inputs import listing
from flows.inputs.sources import LARGEST_FILE_BYTES
from steps.store import room_for

ANSWER_S = 60.0  # for a web server, each time it is asked for more
CHUNK = 1 << 20  # bytes


@contextmanager
def at_hand(address: str) -> Iterator[Path]:
    """The file at an address, on this machine as long as the block runs.

    Args:
        address: a path; `https://...` or `http://...`; or `s3://BUCKET/KEY`, with the usual AWS_* variables.

    Raises:
        BadInput: there is no such file, it is too large, or the address is of no known kind.
        BackendUnavailable: the object store refuses access, or does not answer.
    """
    if "://" not in address:
        yield Path(address)
        return
    parts, shown = urlsplit(address), without_secrets(address)
    name = PurePosixPath(unquote(parts.path)).name
    if parts.scheme not in {"http", "https", "s3"} or not name or "\0" in name:
        raise BadInput(f"{shown} names no file: give a path, https://HOST/FILE or s3://BUCKET/KEY")
    if parts.scheme == "s3":
        folder, _, key = address.rpartition("/")
        with listing.fetched(folder, key, name) as path:
            yield path
        return
    with tempfile.TemporaryDirectory(prefix="dg4d-fetched-") as scratch, room_for(Path(scratch)):
        path = Path(scratch) / name
        try:
            _download(address, path, shown)
        except urllib.error.HTTPError as error:
            error.close()  # it is an answer
            raise BadInput(f"{shown} cannot be fetched: {error.code} {error.reason}") from error
        except (urllib.error.URLError, http.client.HTTPException, TimeoutError) as error:
            raise BadInput(f"{shown} cannot be fetched: {getattr(error, 'reason', '') or error}") from error
        yield path


def without_secrets(address: str) -> str:
    """The address as people may see it, with neither a password nor a signature."""
    parts = urlsplit(address)
    return f"{parts.scheme}://{parts.hostname}{parts.path}" if "://" in address else address


def _download(address: str, path: Path, shown: str) -> None:
    size_bytes = 0
    with urllib.request.urlopen(address, timeout=ANSWER_S) as answer, path.open("wb") as file:
        while chunk := answer.read(CHUNK):
            size_bytes += len(chunk)
            if size_bytes > LARGEST_FILE_BYTES:
                raise BadInput(f"{shown} has more than {LARGEST_FILE_BYTES} bytes; give a shorter one")
            file.write(chunk)
