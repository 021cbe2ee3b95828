"""Free space on the disk of the home folder, asked before a server is started on it."""

import shutil
from pathlib import Path

from steps.store.files import DiskFull

NEEDED_BYTES = 64 * 2**20  # a database, its journal, logs and the records of a run


def require_free_space(place: Path, needed_bytes: int = NEEDED_BYTES) -> None:
    """Refuse to begin where the disk is full or nearly so.

    Args:
        place: a folder that may still have to be made.
        needed_bytes: that must be free.

    Raises:
        DiskFull: says how much is free and how much is needed.
    """
    there = next(folder for folder in (place, *place.absolute().parents) if folder.exists())
    free_bytes = shutil.disk_usage(there).free
    if free_bytes < needed_bytes:
        raise DiskFull(
            f"the disk that holds {place} is full: {free_bytes / 1e6:.1f} MB are free, and {needed_bytes / 1e6:.0f} MB "
            "are needed; free some space, or name a folder on another disk in $DG4D_HOME"
        )
