"""Artifact store in an S3-compatible object store, with a local folder of copies."""

import os
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, cast
from urllib.parse import urlsplit

import obstore
from obstore.exceptions import AlreadyExistsError, BaseError, PermissionDeniedError, UnauthenticatedError
from obstore.store import S3Store

from dg4d_lib.errors import BackendUnavailable, BadInput
from steps.contract import ArtifactRef
from steps.store.artifact_store import (
    CHUNK,
    OBJECTS,
    ArtifactStore,
    Entry,
    StoreUnreachable,
    copy_hashed,
    object_name,
    remove_unused,
)
from steps.store.endpoints import ENDPOINTS, LOOPBACK
from steps.store.files import room_for

if TYPE_CHECKING:
    from obstore.store import ClientConfig, ObjectStore

CONNECT_S = 10.0  # time limit of a connection attempt
YES = {"1", "on", "true", "y", "yes"}  # values of $AWS_ALLOW_HTTP, as obstore reads it
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 5.0  # pauses between attempts, seconds
MOST_ATTEMPTS = 10_000  # more than fit into any time limit
READ_AHEAD = 8 * CHUNK  # bytes per request for a part of an artifact
RENEW_S = 3600.0  # less than the grace of `dg4d store gc`, by more than clocks of machines differ
CLOCK = "clock"  # file that is written to read the time of the object store


class BucketStore(ArtifactStore):
    """Artifacts by content, and small files by name, in an object store.

    The bucket decides which artifacts exist; those read or written here stay as copies in a local folder.

    Args:
        bucket: object store, at the prefix of all names.
        copies: folder of copies; several stores may share one.
        address: address that `open_store` opens.
    """

    is_folder = False

    def __init__(self, bucket: "ObjectStore", copies: Path, address: str) -> None:
        super().__init__(copies)
        self._bucket = bucket
        self._address = address

    @property
    def address(self) -> str:
        """Address of the bucket and the prefix in it."""
        return self._address

    def has(self, ref: ArtifactRef) -> bool:
        """Return True if the artifact is in the bucket with its full size."""
        return self._modified(ref) is not None

    def is_sound(self, ref: ArtifactRef) -> bool:
        """Return True if the artifact is in the bucket with its full size; `get` and `path` check its bytes."""
        return self.has(ref)

    def content_digest(self, digest: str) -> str | None:
        """Return the true digest of the bytes stored under a digest; None if there are none."""
        try:
            with self._answering():
                return copy_hashed(self._reader(digest))[0]
        except FileNotFoundError:
            return None

    def drop(self, digests: Sequence[str]) -> None:
        """Remove artifacts from the bucket, and their copies."""
        super().drop(digests)
        for digest in digests:
            self._path_of(digest).unlink(missing_ok=True)

    def now(self) -> float:
        """Return the time of the object store's clock, in seconds."""
        self.write(CLOCK, "")
        with self._answering():
            return obstore.head(self._bucket, CLOCK)["last_modified"].timestamp()

    def entries(self, folder: str) -> Iterator[Entry]:
        """Yield every file under a folder of the bucket."""
        with self._answering():
            for page in obstore.list(self._bucket, prefix=folder):
                for found in page:
                    yield Entry(found["path"], found["size"], found["last_modified"].timestamp())

    def read(self, name: str) -> bytes | None:
        """Return the content of a small file; None if there is none."""
        try:
            with self._answering():
                return bytes(obstore.get(self._bucket, name).bytes())
        except FileNotFoundError:
            return None

    def fetch(self, name: str, path: Path, most_bytes: int) -> None:
        """Copy a named file of the bucket to `path`, in parts.

        Raises:
            BadInput: it has more than `most_bytes`; nothing is copied.
            FileNotFoundError: no file has this name.
            DiskFull: there is no room at `path`.
        """
        with self._answering(), room_for(path.parent), path.open("wb") as target:
            reader = obstore.open_reader(self._bucket, name, buffer_size=READ_AHEAD)
            if reader.size > most_bytes:
                raise BadInput(f"{name} has {reader.size} bytes; at most {most_bytes} are read: shorten it")
            shutil.copyfileobj(cast(BinaryIO, reader), target, READ_AHEAD)

    def write(self, name: str, text: str) -> None:
        """Write or replace a small file."""
        with self._writing():
            obstore.put(self._bucket, name, text.encode(), use_multipart=False)

    def create(self, name: str, text: str) -> bool:
        """Write a small file unless it exists; one request, as multipart uploads cannot be conditional."""
        try:
            with self._writing():
                obstore.put(self._bucket, name, text.encode(), mode="create", use_multipart=False)
        except AlreadyExistsError:
            return False
        return True

    def remove(self, names: Sequence[str]) -> None:
        """Remove files by name."""
        if names:
            with self._answering():
                obstore.delete(self._bucket, list(names))

    def tidy(self, unused_s: float) -> None:
        """Remove partial files on this machine, and copies that were not read for this many seconds."""
        super().tidy(unused_s)
        remove_unused(self.root / OBJECTS, unused_s)

    def _put(self, source: BinaryIO, media_type: str) -> ArtifactRef:
        """Copy to this machine, which yields the digest, then to the bucket in one upload.

        An equal object is uploaded again if it is older than `RENEW_S`, as garbage collection goes by the age.
        """
        ref = super()._put(source, media_type)
        modified = self._modified(ref)
        if modified is None or time.time() - modified > RENEW_S:
            with self._writing():
                obstore.put(self._bucket, object_name(ref.digest), self._path_of(ref.digest))
        return ref

    def _modified(self, ref: ArtifactRef) -> float | None:
        """Return the time of an artifact in the bucket, by its clock; None if it is not there with its full size."""
        try:
            with self._answering():
                found = obstore.head(self._bucket, object_name(ref.digest))
        except FileNotFoundError:
            return None
        return found["last_modified"].timestamp() if found["size"] == ref.size_bytes else None

    def _file(self, ref: ArtifactRef) -> Path:
        """Return the copy of an artifact, fetched if it is not here or damaged."""
        if not (super().has(ref) and self._is_right(ref)):
            self._fetch(ref)
        place = self._path_of(ref.digest)
        os.utime(place, (time.time(), place.stat().st_mtime))  # `tidy` keeps copies that were used
        return place

    def _fetch(self, ref: ArtifactRef) -> None:
        """Copy an artifact from the bucket to this machine; a damaged one is dropped from the bucket."""
        try:
            with self._answering():
                copy = self._keep(self._reader(ref.digest), ref.media_type)
        except FileNotFoundError as error:
            raise self._missing(ref) from error
        if copy.digest != ref.digest:
            self._path_of(copy.digest).unlink(missing_ok=True)
            self.drop([ref.digest])
            raise self._damaged(ref)

    def _reader(self, digest: str) -> BinaryIO:
        """Open an artifact in the bucket for reading in parts."""
        return cast(BinaryIO, obstore.open_reader(self._bucket, object_name(digest), buffer_size=READ_AHEAD))

    @contextmanager
    def _answering(self) -> Iterator[None]:
        """Turn errors of obstore into those of the library; FileNotFoundError stays."""
        try:
            yield
        except (PermissionDeniedError, UnauthenticatedError) as error:
            raise BackendUnavailable(
                f"{self.address} refuses access ({_reason(error)}): "
                "check AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY and what they are allowed"
            ) from error
        except AlreadyExistsError:
            raise
        except BaseError as error:
            raise StoreUnreachable(
                f"{self.address} does not answer ({_reason(error)}): check the network and AWS_ENDPOINT_URL, then "
                "run the same command again; finished steps are kept"
            ) from error

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            with self._answering():
                yield
        except FileNotFoundError as error:
            raise BackendUnavailable(f"{self.address}: there is no such bucket; make it first") from error


def open_bucket(address: str, copies: Path, patience_s: float) -> BucketStore:
    """Open the store at `s3://BUCKET/PREFIX`, with the usual AWS_* variables.

    Args:
        address: `s3://BUCKET/PREFIX`.
        copies: folder of copies.
        patience_s: seconds for which requests are repeated before they fail.
    """
    bucket = S3Store.from_url(
        address,
        client_options=_client_options(),
        retry_config={
            "max_retries": MOST_ATTEMPTS,
            "retry_timeout": timedelta(seconds=patience_s),
            "backoff": {
                "init_backoff": timedelta(seconds=FIRST_PAUSE_S),
                "max_backoff": timedelta(seconds=LONGEST_PAUSE_S),
                "base": 2,
            },
        },
    )
    return BucketStore(bucket, copies, address)


def _client_options() -> "ClientConfig":
    """Return options that allow plain http to this machine, and elsewhere only with $AWS_ALLOW_HTTP.

    obstore ignores that variable when it is given options.
    """
    options: ClientConfig = {"connect_timeout": timedelta(seconds=CONNECT_S)}
    endpoint = next((os.environ[name] for name in ENDPOINTS if os.environ.get(name)), "")
    if urlsplit(endpoint).hostname in LOOPBACK or os.environ.get("AWS_ALLOW_HTTP", "").lower() in YES:
        options["allow_http"] = True
    return options


def _reason(error: BaseError) -> str:
    """Return the reason of an error, without the request and the attempts."""
    return str(error).partition("\n")[0].rpartition(" - ")[2].strip()
