"""Check of the free space on a disk, before a server is started or weights are downloaded on it."""

import shutil
from pathlib import Path

from steps.store.files import DiskFull

NEEDED_BYTES = 64 * 2**20  # a database, its journal, logs and the records of a run


def require_free_space(folder: Path) -> None:
    """Raise DiskFull if fewer than `NEEDED_BYTES` are free on the disk of a folder, which need not exist yet."""
    free_bytes = free_space(folder)
    if free_bytes < NEEDED_BYTES:
        raise DiskFull(
            f"the disk of {folder} is full: {free_bytes / 1e6:.1f} MB are free, and {NEEDED_BYTES / 1e6:.0f} MB are "
            "needed; free some space, or name a folder on another disk in $DG4D_HOME"
        )


def require_room_for_weights(folder: Path, size_bytes: int) -> None:
    """Raise DiskFull if a download does not fit on the disk of the weights folder."""
    free_bytes = free_space(folder)
    if free_bytes < size_bytes:
        raise DiskFull(
            f"the download of {size_bytes / 1e9:.2f} GB does not fit on the disk of {folder}: "
            f"{free_bytes / 1e9:.2f} GB are free; free some space, or name a folder on another disk in $DG4D_WEIGHTS"
        )


def free_space(folder: Path) -> int:
    """Return the bytes that are free on the disk of a folder, which need not exist yet."""
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    return shutil.disk_usage(existing).free
