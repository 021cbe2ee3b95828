"""The store in a bucket of an S3-compatible object store, with a folder of copies in front."""

import hashlib
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
    ArtifactMissing,
    ArtifactStore,
    Entry,
    StoreUnreachable,
    object_name,
)
from steps.store.endpoints import ENDPOINTS, LOOPBACK
from steps.store.files import room_for

if TYPE_CHECKING:
    from obstore.store import ClientConfig, ObjectStore

CONNECT_S = 10.0
YES = {"1", "on", "true", "y", "yes"}  # of $AWS_ALLOW_HTTP, as the library reads it
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 5.0  # between two attempts
MOST_ATTEMPTS = 10_000  # patience ends them first
READ_AHEAD = 8 * CHUNK  # bytes of one request for a part of an artifact
CLOCK = "clock"  # a file that is written to learn the time


class BucketStore(ArtifactStore):
    """Artifacts by content, and small files by name, in an object store.

    What is read or written stays as a copy in a folder on this machine; whether an artifact exists, the bucket says.

    Args:
        bucket: the object store, at the prefix under which everything lies.
        copies: the folder of copies; several stores may share one.
        address: what opens this store again.
    """

    def __init__(self, bucket: "ObjectStore", copies: Path, address: str) -> None:
        super().__init__(copies)
        self._bucket = bucket
        self._address = address

    @property
    def address(self) -> str:
        """The address of the bucket and the prefix in it."""
        return self._address

    def get(self, ref: ArtifactRef, path: Path) -> None:
        """As the folder does; a damaged copy is fetched again."""
        try:
            super().get(ref, path)
        except ArtifactMissing:
            super().get(ref, path)

    def path(self, ref: ArtifactRef) -> Path:
        """The copy of an artifact; a damaged one is fetched again."""
        try:
            return super().path(ref)
        except ArtifactMissing:
            return super().path(ref)

    def has(self, ref: ArtifactRef) -> bool:
        """Whether the artifact is in the bucket with its full size."""
        return self._size(ref.digest) == ref.size_bytes

    def is_sound(self, ref: ArtifactRef) -> bool:
        """Whether the artifact is in the bucket with its full size; its bytes are checked when they are fetched."""
        return self.has(ref)

    def content_digest(self, digest: str) -> str | None:
        """What the bytes kept under a digest really hash to; None if there are none."""
        content = hashlib.sha256()
        try:
            with self._answering():
                file = self._reader(digest)
                while chunk := file.read(READ_AHEAD):
                    content.update(chunk)
        except FileNotFoundError:
            return None
        return f"sha256:{content.hexdigest()}"

    def drop(self, digests: Sequence[str]) -> None:
        """Remove artifacts from the bucket, and their copies."""
        super().drop(digests)
        for digest in digests:
            self._place(digest).unlink(missing_ok=True)

    def now(self) -> float:
        """The time by the clock of the object store."""
        self.write(CLOCK, "")
        with self._answering():
            return obstore.head(self._bucket, CLOCK)["last_modified"].timestamp()

    def entries(self, folder: str) -> Iterator[Entry]:
        """Every file under a folder of the bucket."""
        with self._answering():
            for page in obstore.list(self._bucket, prefix=folder):
                for found in page:
                    yield Entry(found["path"], found["size"], found["last_modified"].timestamp())

    def read(self, name: str) -> bytes | None:
        """The content of a small file; None if there is none."""
        try:
            with self._answering():
                return bytes(obstore.get(self._bucket, name).bytes())
        except FileNotFoundError:
            return None

    def fetch(self, name: str, path: Path, most_bytes: int) -> None:
        """Copy any file of the bucket to `path`, in parts.

        Raises:
            BadInput: it has more than `most_bytes`; nothing is copied.
            FileNotFoundError: there is none of that name.
            DiskFull: there is no room at `path`.
            StoreUnreachable: the bucket does not answer.
        """
        with self._answering(), room_for(path.parent), path.open("wb") as target:
            reader = obstore.open_reader(self._bucket, name, buffer_size=READ_AHEAD)
            if reader.size > most_bytes:
                raise BadInput(f"{name} has {reader.size} bytes; at most {most_bytes} are read: shorten it")
            shutil.copyfileobj(cast(BinaryIO, reader), target, READ_AHEAD)

    def write(self, name: str, text: str) -> None:
        """Write a small file, or replace it."""
        with self._writing():
            obstore.put(self._bucket, name, text.encode(), use_multipart=False)

    def create(self, name: str, text: str) -> bool:
        """Write a small file unless there is one; one request, for object stores enforce no condition on more."""
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
        """Remove what was left half-written on this machine, and copies that nobody read for so many seconds."""
        super().tidy(unused_s)
        self._forget(self.root / OBJECTS, unused_s)

    def _keep(self, source: BinaryIO, media_type: str) -> ArtifactRef:
        """Copy to this machine first, so that the name is known; then to the bucket, whole or not at all."""
        ref = super()._keep(source, media_type)
        if not self.has(ref):
            with self._writing():
                obstore.put(self._bucket, object_name(ref.digest), self._place(ref.digest))
        return ref

    def _file(self, ref: ArtifactRef) -> Path:
        """The copy of an artifact, fetched if it is not here."""
        if not self._is_here(ref):
            self._fetch(ref)
        place = self._place(ref.digest)
        os.utime(place, (time.time(), place.stat().st_mtime))  # it was used; its content is as old as before
        return place

    def _fetch(self, ref: ArtifactRef) -> None:
        try:
            with self._answering():
                copy = super()._keep(self._reader(ref.digest), ref.media_type)
        except FileNotFoundError as error:
            raise self._missing(ref) from error
        if copy.digest != ref.digest:
            self._place(copy.digest).unlink(missing_ok=True)
            self.drop([ref.digest])
            raise self._damaged(ref)

    def _reader(self, digest: str) -> BinaryIO:
        """An artifact in the bucket, read in parts."""
        return cast(BinaryIO, obstore.open_reader(self._bucket, object_name(digest), buffer_size=READ_AHEAD))

    def _size(self, digest: str) -> int | None:
        """Bytes of an artifact in the bucket; None if it is not there."""
        try:
            with self._answering():
                return obstore.head(self._bucket, object_name(digest))["size"]
        except FileNotFoundError:
            return None

    @contextmanager
    def _answering(self) -> Iterator[None]:
        """Turn what the client says into our errors; a file that is not there stays a FileNotFoundError."""
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
    """The store at `s3://BUCKET/PREFIX`, with the usual AWS_* variables.

    Args:
        address: that.
        copies: the folder of copies.
        patience_s: how long requests are repeated before they fail.
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
    """Plain http goes to this machine itself; elsewhere $AWS_ALLOW_HTTP must allow it.

    The library reads that variable only where it is given no options.
    """
    options: ClientConfig = {"connect_timeout": timedelta(seconds=CONNECT_S)}
    endpoint = next((os.environ[name] for name in ENDPOINTS if os.environ.get(name)), "")
    if urlsplit(endpoint).hostname in LOOPBACK or os.environ.get("AWS_ALLOW_HTTP", "").lower() in YES:
        options["allow_http"] = True
    return options


def _reason(error: BaseError) -> str:
    """What went wrong, without the request and the attempts."""
    return str(error).partition("\n")[0].rpartition(" - ")[2].strip()
