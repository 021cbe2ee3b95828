"""Files on this machine: home folder, atomic writes and the error for a full disk."""

import errno
import os
import shutil
import stat
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from dg4d_lib.errors import BadInput

FOLDER_VARIABLES = ("DG4D_HOME", "DG4D_STORE", "DG4D_WEIGHTS")
NO_SPACE = {errno.ENOSPC, errno.EDQUOT}


class DiskFull(BadInput):
    """No room for a file; no partial file is left."""


def home() -> Path:
    """Return the folder of everything that outlives a command: `$DG4D_HOME`, else the platform's user data folder."""
    given = os.environ.get("DG4D_HOME")
    if given:
        return Path(given).expanduser().absolute()
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(data) / "dg4d"


def make_folders_absolute() -> None:
    """Make folders that environment variables name absolute: child processes have other current folders."""
    for name in FOLDER_VARIABLES:
        given = os.environ.get(name)
        if given and "://" not in given:
            os.environ[name] = str(Path(given).expanduser().absolute())


@contextmanager
def room_for(place: Path) -> Iterator[None]:
    """Turn "no space left" in the block into `DiskFull`, which names the disk of `place`.

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


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file so that a reader sees the old content or the new one, never a part.

    Threads may write the same file at once; the last one wins.

    Raises:
        DiskFull: there is no room; the old content stays.
    """
    scratch = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}")
    with room_for(path.parent):
        try:
            with scratch.open("wb") as file:
                file.write(content.encode() if isinstance(content, str) else content)
                file.flush()
                os.fsync(file.fileno())
            scratch.replace(path)
        finally:
            with suppress(OSError):
                scratch.unlink(missing_ok=True)


def walk(folder: Path) -> Iterator[Path]:
    """Yield everything below a folder; what others remove meanwhile is left out, which `Path.rglob` does not do."""
    for place, folders, names in os.walk(folder):
        yield from (Path(place, name) for name in (*folders, *names))


def require_regular(path: Path) -> None:
    """Refuse everything but a regular file: reading a FIFO or a device may never end.

    Raises:
        OSError: there is no such file, or it is a folder, a FIFO, a socket or a device.
    """
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError(errno.EINVAL, "not a regular file", str(path))


def remove_tree(folder: Path) -> None:
    """Remove a folder that may hold anything, or may be gone already."""
    shutil.rmtree(folder, ignore_errors=True)
