"""Content-addressed artifacts and small named files in a folder; `steps/store/bucket.py` keeps them in an object store.

sha256/ab/ab12...   artifacts, each under the digest of its content, never changed
incoming/           artifacts that are being written, on this machine only
anything else       small files by name, each written at once: records about artifacts
"""

import hashlib
import io
import json
import os
import stat
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import IO, Any, BinaryIO, ClassVar, NamedTuple

from dg4d_lib.errors import BackendUnavailable, BadInput, DG4DError
from steps.contract import ArtifactRef, is_digest
from steps.store.files import room_for, walk, write_atomically

CHUNK = 1 << 20  # bytes read at a time
OBJECTS, INCOMING = "sha256", "incoming"


class ArtifactMissing(DG4DError):
    """Missing or damaged artifact; running the step again restores it."""


class StoreUnreachable(BackendUnavailable):
    """Object store that does not answer; a retry may succeed."""


class Entry(NamedTuple):
    """One file of a store.

    Attributes:
        name: path under the root, with slashes.
        size_bytes: size of its content.
        modified: time of writing, in seconds of the store's own clock.
    """

    name: str
    size_bytes: int
    modified: float


class ArtifactStore:
    """Artifacts by content, and small files by name, in a folder.

    With an object store, all methods raise StoreUnreachable if it does not answer; with a folder of another user, those
    that need access which this user lacks raise BadInput.

    Args:
        root: folder, made when the first file is put.

    Attributes:
        is_folder: whether `root` holds the files; else an object store does, and `root` has copies.
    """

    is_folder: ClassVar[bool] = True

    def __init__(self, root: Path) -> None:
        self.root = Path(root).absolute()
        self._verified: dict[Path, tuple[int, int, int]] = {}  # inode, time and size of files with the right content

    @property
    def address(self) -> str:
        """Address that `open_store` opens: a folder, or that of an object store."""
        return str(self.root)

    def put(self, path: Path, media_type: str) -> ArtifactRef:
        """Store a copy of a file.

        Raises:
            DiskFull: there is no room; the store is as it was.
        """
        with path.open("rb") as source:
            return self._put(source, media_type)

    def put_bytes(self, content: bytes, media_type: str) -> ArtifactRef:
        """Store some bytes; raises as `put` does."""
        return self._put(io.BytesIO(content), media_type)

    def get(self, ref: ArtifactRef, path: Path) -> None:
        """Copy an artifact to `path`; changes of the copy do not affect the store.

        Raises:
            ArtifactMissing: it is not here, or its bytes do not match its digest (then it is dropped).
            DiskFull: there is no room at `path`.
        """
        with room_for(path.parent), self._opened(ref) as source, path.open("wb") as target:
            digest, _ = copy_hashed(source, target)
        if digest != ref.digest:
            path.unlink()
            raise self._damaged(ref)

    def has(self, ref: ArtifactRef) -> bool:
        """Return True if the artifact is here with its full size."""
        try:
            with self._allowed():
                return self._path_of(ref.digest).stat().st_size == ref.size_bytes
        except FileNotFoundError:
            return False

    def is_sound(self, ref: ArtifactRef) -> bool:
        """Return True if the artifact is here and matches its digest; unchanged files are read once per process."""
        return self.has(ref) and self._is_right(ref)

    def path(self, ref: ArtifactRef) -> Path:
        """Return a file with the content of an artifact, for reading only.

        Raises:
            ArtifactMissing: it is not here, or its bytes do not match its digest (then it is dropped).
        """
        file = self._file(ref)
        if not self._is_right(ref):
            raise self._damaged(ref)
        return file

    def load_json(self, ref: ArtifactRef) -> Any:
        """Return the content of a JSON artifact.

        Raises:
            ArtifactMissing: as `path`.
        """
        return json.loads(self.path(ref).read_text(encoding="utf-8"))

    def now(self) -> float:
        """Return the time of the clock behind `Entry.modified`, in seconds."""
        return time.time()

    def artifacts(self) -> Iterator[Entry]:
        """Yield every artifact, named by its digest, in no certain order."""
        for entry in self.entries(OBJECTS):
            digest = f"sha256:{PurePosixPath(entry.name).name}"
            if is_digest(digest):
                yield entry._replace(name=digest)

    def content_digest(self, digest: str) -> str | None:
        """Return the true digest of the bytes stored under a digest; None if there are none."""
        try:
            with self._allowed(), self._path_of(digest).open("rb") as file:
                return _digest(file)
        except FileNotFoundError:
            return None

    def drop(self, digests: Sequence[str]) -> None:
        """Remove artifacts; those that are gone already are ignored."""
        self.remove([object_name(digest) for digest in digests])

    def entries(self, folder: str) -> Iterator[Entry]:
        """Yield every file under a folder of the store, in no certain order."""
        for path, status in _files(self.root / folder):
            if not path.name.startswith("."):
                yield Entry(path.relative_to(self.root).as_posix(), status.st_size, status.st_mtime)

    def read(self, name: str) -> bytes | None:
        """Return the content of a small file; None if there is none."""
        try:
            with self._allowed():
                return (self.root / name).read_bytes()
        except FileNotFoundError:
            return None

    def write(self, name: str, text: str) -> None:
        """Write or replace a small file; readers see the old content or the new one.

        Raises:
            DiskFull: there is no room; the old content stays.
        """
        with self._allowed():
            write_atomically(self._new_file(name), text)

    def create(self, name: str, text: str) -> bool:
        """Write a small file unless one of this name exists; return True for the one caller that wrote it.

        Raises:
            DiskFull: there is no room; no file is left.
        """
        with room_for(self.root), self._allowed():
            path = self._new_file(name)
            try:
                file = path.open("x", encoding="utf-8")
            except FileExistsError:
                return False
            try:
                with file:
                    file.write(text)
            except OSError:
                path.unlink(missing_ok=True)
                raise
        return True

    def remove(self, names: Sequence[str]) -> None:
        """Remove files by name; those that are gone already are ignored."""
        with self._allowed():
            for name in names:
                (self.root / name).unlink(missing_ok=True)

    def tidy(self, unused_s: float) -> None:
        """Remove partial files of killed processes that are unused for this many seconds."""
        remove_unused(self.root / INCOMING, unused_s)

    def _new_file(self, name: str) -> Path:
        """Return the path of a named file, in a folder that exists."""
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def _path_of(self, digest: str) -> Path:
        return self.root / object_name(digest)

    def _is_right(self, ref: ArtifactRef) -> bool:
        """Return True if the file of an artifact matches its digest."""
        place = self._path_of(ref.digest)
        try:
            with self._allowed(), place.open("rb") as file:
                version = _version(os.fstat(file.fileno()))
                if self._verified.get(place) != version:
                    if _digest(file) != ref.digest:
                        return False
                    self._verified[place] = version
        except FileNotFoundError:
            return False
        return True

    def _file(self, ref: ArtifactRef) -> Path:
        """Return the file of an artifact, which has the right size."""
        if not self.has(ref):
            raise self._missing(ref)
        return self._path_of(ref.digest)

    def _opened(self, ref: ArtifactRef) -> BinaryIO:
        with self._allowed():
            return self._file(ref).open("rb")

    @contextmanager
    def _allowed(self) -> Iterator[None]:
        """Turn a refused access in the block into BadInput, which names the owner of the file or folder."""
        try:
            yield
        except PermissionError as error:
            path = Path(error.filename2 or error.filename or self.root)
            raise BadInput(
                f"{path}, in the store {self.root}, belongs to {_owner(path)}, and this user may not use it: a folder "
                "is the store of one user; set $DG4D_STORE to a folder of your own, or for several users to "
                "s3://BUCKET/PREFIX"
            ) from error

    def _missing(self, ref: ArtifactRef) -> ArtifactMissing:
        return ArtifactMissing(
            f"artifact {ref.digest} ({ref.media_type}) is not in {self.address}: run the same command again to renew it"
        )

    def _damaged(self, ref: ArtifactRef) -> ArtifactMissing:
        """Drop the file of an artifact and return the error to raise."""
        self._path_of(ref.digest).unlink(missing_ok=True)
        return ArtifactMissing(
            f"artifact {ref.digest} ({ref.media_type}) was damaged: run the same command again to renew it"
        )

    def _put(self, source: BinaryIO, media_type: str) -> ArtifactRef:
        """Store a stream from its beginning; of one that is here and sound, only the time is renewed."""
        digest, size = copy_hashed(source)
        ref = ArtifactRef(digest=digest, media_type=media_type, size_bytes=size)
        if self._renewed(ref):
            return ref
        source.seek(0)
        return self._keep(source, media_type)

    def _renewed(self, ref: ArtifactRef) -> bool:
        """Return True if the artifact is here and sound; garbage collection then counts its age from now on."""
        place = self._path_of(ref.digest)
        with suppress(FileNotFoundError, PermissionError):  # it was removed meanwhile, or cannot be renewed
            if self._is_right(ref):
                os.utime(place)
                self._verified[place] = _version(place.stat())
                return True
        return False

    def _keep(self, source: BinaryIO, media_type: str) -> ArtifactRef:
        """Copy a stream into the store; an existing file is replaced, for it may be damaged."""
        with (
            room_for(self.root),
            self._allowed(),
            tempfile.NamedTemporaryFile(dir=self._new_file(f"{INCOMING}/new").parent, delete=False) as target,
        ):
            scratch = Path(target.name)
            try:
                digest, size = copy_hashed(source, target)
                target.flush()
                os.fsync(target.fileno())
                scratch.chmod(0o400)  # read-only, for this user alone
                scratch.replace(self._new_file(object_name(digest)))
            finally:
                scratch.unlink(missing_ok=True)
        return ArtifactRef(digest=digest, media_type=media_type, size_bytes=size)


def object_name(digest: str) -> str:
    """Return the name of an artifact's file in a store."""
    name = digest.removeprefix("sha256:")
    return f"{OBJECTS}/{name[:2]}/{name}"


def _files(folder: Path) -> Iterator[tuple[Path, os.stat_result]]:
    """Yield every regular file under a folder; others may remove files meanwhile."""
    for path in walk(folder):
        with suppress(FileNotFoundError):
            status = path.stat()
            if stat.S_ISREG(status.st_mode):
                yield path, status


def remove_unused(folder: Path, unused_s: float) -> None:
    """Remove the files of a folder that were not read or written for this many seconds."""
    for path, status in _files(folder):
        if time.time() - max(status.st_mtime, status.st_atime) > unused_s:
            path.unlink(missing_ok=True)


def _digest(file: io.BufferedReader) -> str:
    return f"sha256:{hashlib.file_digest(file, 'sha256').hexdigest()}"


def _version(status: os.stat_result) -> tuple[int, int, int]:
    """Return the version of a file: inode, time and size."""
    return status.st_ino, status.st_mtime_ns, status.st_size


def _owner(path: Path) -> str:
    """Return the name of the user that a path, or the nearest folder above it that can be seen, belongs to."""
    for place in (path, *path.parents):
        try:
            return f"the user {place.owner()}"
        except KeyError:
            return f"the user {place.stat().st_uid}"
        except OSError:
            continue
    return "another user"


def copy_hashed(source: BinaryIO, target: IO[bytes] | None = None) -> tuple[str, int]:
    """Read a stream to its end, and copy it to `target`; return the digest and the number of bytes."""
    content, size = hashlib.sha256(), 0
    while chunk := source.read(CHUNK):
        content.update(chunk)
        size += len(chunk)
        if target is not None:
            target.write(chunk)
    return f"sha256:{content.hexdigest()}", size
