"""Check of the free space on the disk of the home folder, before a server is started on it."""

import shutil
from pathlib import Path

from steps.store.files import DiskFull

NEEDED_BYTES = 64 * 2**20  # a database, its journal, logs and the records of a run


def require_free_space(folder: Path) -> None:
    """Raise DiskFull if fewer than `NEEDED_BYTES` are free on the disk of a folder, which need not exist yet."""
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    free_bytes = shutil.disk_usage(existing).free
    if free_bytes < NEEDED_BYTES:
        raise DiskFull(
            f"the disk of {folder} is full: {free_bytes / 1e6:.1f} MB are free, and {NEEDED_BYTES / 1e6:.0f} MB are "
            "needed; free some space, or name a folder on another disk in $DG4D_HOME"
        )
