"""Where artifacts live: a file is kept once, under the sha256 of its content, and never changes.

This is the folder on one machine; `steps/store/bucket.py` has the same in an object store.

    sha256/ab/ab12...   artifacts, each under the digest of its content
    incoming/           artifacts that are being written, on this machine only
    anything else       small files by name, each written at once, of those who keep records about artifacts
"""

import hashlib
import io
import os
import stat
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import BinaryIO, NamedTuple

from dg4d_lib.errors import BackendUnavailable, DG4DError
from steps.contract import ArtifactRef, is_digest
from steps.store.files import room_for, write_atomically

CHUNK = 1 << 20  # bytes read at a time
OBJECTS, INCOMING = "sha256", "incoming"


class ArtifactMissing(DG4DError):
    """A reference whose bytes are gone or damaged; making them again is the cure."""


class StoreUnreachable(BackendUnavailable):
    """The store does not answer at the moment; the same again may work."""


class Entry(NamedTuple):
    """One file of a store.

    Attributes:
        name: its place under the root, with slashes.
        size_bytes: of its content.
        modified: when it was written, in seconds of the store's own clock.
    """

    name: str
    size_bytes: int
    modified: float


class ArtifactStore:
    """Artifacts by content, and small files by name, in a folder.

    Args:
        root: made when the first file is put.
    """

    def __init__(self, root: Path) -> None:
        self.root = Path(root).absolute()
        self._sound: dict[Path, tuple[int, int, int]] = {}  # inode, time, size of files whose content was right

    @property
    def address(self) -> str:
        """What opens this store again: a folder, or an address of an object store."""
        return str(self.root)

    def put(self, path: Path, media_type: str) -> ArtifactRef:
        """Keep a copy of a file.

        Raises:
            DiskFull: there is no room; the store is as it was.
            StoreUnreachable: the store does not answer.
        """
        with path.open("rb") as source:
            return self._keep(source, media_type)

    def put_bytes(self, content: bytes, media_type: str) -> ArtifactRef:
        """Keep some bytes; raises as `put` does."""
        return self._keep(io.BytesIO(content), media_type)

    def get(self, ref: ArtifactRef, path: Path) -> None:
        """Write an artifact to `path` as a file of its own, which may be changed without harm to the store.

        Raises:
            ArtifactMissing: it is not here, or its bytes are not what its name says (then it is dropped).
            DiskFull: there is no room at `path`.
            StoreUnreachable: the store does not answer.
        """
        with room_for(path.parent), self._file(ref).open("rb") as source, path.open("wb") as target:
            digest, _ = _copy(source, target)
        if digest != ref.digest:
            path.unlink()
            raise self._damaged(ref)

    def has(self, ref: ArtifactRef) -> bool:
        """Whether the artifact is here with its full size.

        Raises:
            StoreUnreachable: the store does not answer.
        """
        return self._is_here(ref)

    def is_sound(self, ref: ArtifactRef) -> bool:
        """Whether the artifact is here and every byte is right; a file that did not change is read once per process.

        Raises:
            StoreUnreachable: the store does not answer.
        """
        return self._is_here(ref) and self._is_right(ref)

    def path(self, ref: ArtifactRef) -> Path:
        """A file with the content of an artifact, for reading only.

        Raises:
            ArtifactMissing: it is not here, or its bytes are not what its name says (then it is dropped).
            StoreUnreachable: the store does not answer.
        """
        file = self._file(ref)
        if not self._is_right(ref):
            raise self._damaged(ref)
        return file

    def now(self) -> float:
        """The time by the clock that `Entry.modified` is read from, in seconds."""
        return time.time()

    def artifacts(self) -> Iterator[Entry]:
        """Every artifact, called by its digest, in no certain order."""
        for entry in self.entries(OBJECTS):
            digest = f"sha256:{PurePosixPath(entry.name).name}"
            if is_digest(digest):
                yield entry._replace(name=digest)

    def content_digest(self, digest: str) -> str | None:
        """What the bytes kept under a digest really hash to; None if there are none."""
        try:
            with self._place(digest).open("rb") as file:
                return _digest(file)
        except FileNotFoundError:
            return None

    def drop(self, digests: Sequence[str]) -> None:
        """Remove artifacts; those that are gone already do not matter."""
        self.remove([object_name(digest) for digest in digests])

    def entries(self, folder: str) -> Iterator[Entry]:
        """Every file under a folder of the store, in no certain order."""
        for path in (self.root / folder).rglob("*"):
            with suppress(FileNotFoundError):
                facts = path.stat()
                if stat.S_ISREG(facts.st_mode) and not path.name.startswith("."):
                    yield Entry(path.relative_to(self.root).as_posix(), facts.st_size, facts.st_mtime)

    def read(self, name: str) -> bytes | None:
        """The content of a small file; None if there is none."""
        try:
            return (self.root / name).read_bytes()
        except FileNotFoundError:
            return None

    def write(self, name: str, text: str) -> None:
        """Write a small file, or replace it: readers see the old content or the new one.

        Raises:
            DiskFull: there is no room; the old content stays.
            StoreUnreachable: the store does not answer.
        """
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, text)

    def create(self, name: str, text: str) -> bool:
        """Write a small file unless there is one of this name; whether it was written. One of many callers wins."""
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with room_for(path.parent), path.open("x", encoding="utf-8") as file:
                file.write(text)
        except FileExistsError:
            return False
        return True

    def remove(self, names: Sequence[str]) -> None:
        """Remove files by name; those that are gone already do not matter."""
        for name in names:
            (self.root / name).unlink(missing_ok=True)

    def tidy(self, unused_s: float) -> None:
        """Remove what killed processes left half-written and nobody touched for so many seconds."""
        self._forget(self.root / INCOMING, unused_s)

    def _forget(self, folder: Path, unused_s: float) -> None:
        """Remove the files of a folder on this machine that nobody touched for so many seconds."""
        for path in folder.rglob("*"):
            with suppress(FileNotFoundError):
                facts = path.stat()
                if stat.S_ISREG(facts.st_mode) and time.time() - max(facts.st_mtime, facts.st_atime) > unused_s:
                    path.unlink()

    def _place(self, digest: str) -> Path:
        return self.root / object_name(digest)

    def _is_here(self, ref: ArtifactRef) -> bool:
        try:
            return self._place(ref.digest).stat().st_size == ref.size_bytes
        except FileNotFoundError:
            return False

    def _is_right(self, ref: ArtifactRef) -> bool:
        """Whether the file in an artifact's place has its content."""
        place = self._place(ref.digest)
        try:
            with place.open("rb") as file:
                facts = os.fstat(file.fileno())
                version = facts.st_ino, facts.st_mtime_ns, facts.st_size
                if self._sound.get(place) != version:
                    if _digest(file) != ref.digest:
                        return False
                    self._sound[place] = version
        except FileNotFoundError:
            return False
        return True

    def _file(self, ref: ArtifactRef) -> Path:
        """The file in an artifact's place, of the right size."""
        if not self._is_here(ref):
            raise self._missing(ref)
        return self._place(ref.digest)

    def _missing(self, ref: ArtifactRef) -> ArtifactMissing:
        return ArtifactMissing(
            f"artifact {ref.digest} ({ref.media_type}) is not in {self.address}: run the same command again to renew it"
        )

    def _damaged(self, ref: ArtifactRef) -> ArtifactMissing:
        """Drop what is in an artifact's place; the error that says so."""
        self._place(ref.digest).unlink(missing_ok=True)
        return ArtifactMissing(
            f"artifact {ref.digest} ({ref.media_type}) was damaged: run the same command again to renew it"
        )

    def _keep(self, source: BinaryIO, media_type: str) -> ArtifactRef:
        """Copy to the end, and put the copy into its place; what is there is replaced, for it may be damaged."""
        with room_for(self.root):
            incoming = self.root / INCOMING
            incoming.mkdir(parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(dir=incoming)
            scratch = Path(name)
            try:
                with os.fdopen(handle, "wb") as target:
                    digest, size = _copy(source, target)
                    target.flush()
                    os.fsync(target.fileno())
                place = self._place(digest)
                place.parent.mkdir(parents=True, exist_ok=True)
                scratch.chmod(0o400)  # never changed; nobody else's business
                scratch.replace(place)
            finally:
                scratch.unlink(missing_ok=True)
        return ArtifactRef(digest=digest, media_type=media_type, size_bytes=size)


def object_name(digest: str) -> str:
    """Where a store keeps an artifact."""
    name = digest.removeprefix("sha256:")
    return f"{OBJECTS}/{name[:2]}/{name}"


def _digest(file: BinaryIO) -> str:
    """What the rest of a file hashes to."""
    return _copy(file, None)[0]


def _copy(source: BinaryIO, target: BinaryIO | None) -> tuple[str, int]:
    """Read to the end, and copy to `target` if there is one; the digest and the number of bytes."""
    content, size = hashlib.sha256(), 0
    while chunk := source.read(CHUNK):
        content.update(chunk)
        if target is not None:
            target.write(chunk)
        size += len(chunk)
    return f"sha256:{content.hexdigest()}", size
