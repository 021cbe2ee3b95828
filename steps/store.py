"""Where artifacts live: a file is kept once, under the sha256 of its content, and never changes.

A directory is enough for one machine. An object store would offer the same five methods.
"""

import errno
import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from dg4d_lib.errors import BadInput, DG4DError
from steps.contract import ArtifactRef

CHUNK = 1 << 20  # bytes read at a time
NO_SPACE = {errno.ENOSPC, errno.EDQUOT}


class ArtifactMissing(DG4DError):
    """A reference whose bytes are gone or damaged; making them again is the cure."""


class DiskFull(BadInput):
    """No room for a file; nothing half-written was left."""


def home() -> Path:
    """Where everything that outlives a command is kept: `$DG4D_HOME`, else the platform's user data folder."""
    given = os.environ.get("DG4D_HOME")
    if given:
        return Path(given).expanduser().absolute()
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(data) / "dg4d"


@contextmanager
def room_for(place: Path) -> Iterator[None]:
    """Turn "no space left" into one clear sentence about `place`.

    Raises:
        DiskFull: the disk, or the user's share of it, is full.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in NO_SPACE:
            raise
        raise DiskFull(
            f"the disk that holds {place} is full: free some space and run the same command again; "
            "finished steps are kept and are not computed again"
        ) from error


class ArtifactStore:
    """Artifacts by content, in a directory.

    Args:
        root: made when the first artifact is put.
    """

    def __init__(self, root: Path) -> None:
        self.root = Path(root).absolute()

    def put(self, path: Path, media_type: str) -> ArtifactRef:
        """Keep a copy of a file.

        Raises:
            DiskFull: there is no room; the store is as it was.
        """
        with path.open("rb") as source:
            return self._keep(source, media_type)

    def put_bytes(self, content: bytes, media_type: str) -> ArtifactRef:
        """Keep some bytes; raises as `put` does."""
        with tempfile.SpooledTemporaryFile(max_size=len(content) + 1) as source:
            source.write(content)
            source.seek(0)
            return self._keep(source, media_type)

    def get(self, ref: ArtifactRef, path: Path) -> None:
        """Write an artifact to `path` as a file of its own, which may be changed without harm to the store.

        Raises:
            ArtifactMissing: it is not here, or its bytes are not what its name says (then it is dropped).
            DiskFull: there is no room at `path`.
        """
        with room_for(path.parent), self.path(ref).open("rb") as source, path.open("wb") as target:
            digest, _ = _copy(source, target)
        if digest != ref.digest:
            path.unlink()
            self._place(ref.digest).unlink(missing_ok=True)
            raise ArtifactMissing(f"artifact {ref.digest} was damaged on disk: run the same command again to renew it")

    def has(self, ref: ArtifactRef) -> bool:
        """Whether the artifact is here with its full size."""
        try:
            return self._place(ref.digest).stat().st_size == ref.size_bytes
        except FileNotFoundError:
            return False

    def path(self, ref: ArtifactRef) -> Path:
        """The stored file, for reading only.

        Raises:
            ArtifactMissing: it is not here.
        """
        if not self.has(ref):
            raise ArtifactMissing(
                f"artifact {ref.digest} ({ref.media_type}) is not in {self.root}: "
                "run the same command again to renew it"
            )
        return self._place(ref.digest)

    def _place(self, digest: str) -> Path:
        name = digest.removeprefix("sha256:")
        return self.root / "sha256" / name[:2] / name

    def _keep(self, source: BinaryIO | tempfile.SpooledTemporaryFile[bytes], media_type: str) -> ArtifactRef:
        with room_for(self.root):
            incoming = self.root / "incoming"
            incoming.mkdir(parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(dir=incoming)
            scratch = Path(name)
            try:
                with os.fdopen(handle, "wb") as target:
                    digest, size = _copy(source, target)
                    target.flush()
                    os.fsync(target.fileno())
                ref = ArtifactRef(digest=digest, media_type=media_type, size_bytes=size)
                if not self.has(ref):  # also replaces a file of the wrong size
                    place = self._place(digest)
                    place.parent.mkdir(parents=True, exist_ok=True)
                    scratch.chmod(0o444)
                    scratch.replace(place)
            finally:
                scratch.unlink(missing_ok=True)
        return ref


def _copy(source: BinaryIO | tempfile.SpooledTemporaryFile[bytes], target: BinaryIO) -> tuple[str, int]:
    """Copy to the end; the digest and the number of bytes."""
    content, size = hashlib.sha256(), 0
    while chunk := source.read(CHUNK):
        content.update(chunk)
        target.write(chunk)
        size += len(chunk)
    return f"sha256:{content.hexdigest()}", size


def write_atomically(path: Path, text: str) -> None:
    """Write a text file so that a reader sees the old content or the new one, never a part.

    Raises:
        DiskFull: there is no room; the old content stays.
    """
    scratch = path.with_name(f".{path.name}.{os.getpid()}")
    with room_for(path.parent):
        try:
            with scratch.open("w", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            scratch.replace(path)
        finally:
            with suppress(OSError):
                scratch.unlink(missing_ok=True)


def remove_tree(folder: Path) -> None:
    """Remove a folder that may hold anything, or may be gone already."""
    shutil.rmtree(folder, ignore_errors=True)
