"""First-come-first-served queues between the processes of a user: files in order of age, locked by their owners.

A ticket is a file whose name sorts by the age of its item, then by its own; the lock of the file ends with its process.
"""

import itertools
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from flows.processes import locked

_numbers = itertools.count()


@contextmanager
def ticket(folder: Path, begun_ns: int, holder: str) -> Iterator[Path]:
    """Hold a place in a queue while the block runs.

    Args:
        folder: folder of the queue; created if missing.
        begun_ns: start of the conversion, nanoseconds since the epoch; earlier goes first.
        holder: name shown to later tickets.

    Yields:
        The ticket.
    """
    folder.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=folder, suffix=".new")
    os.close(handle)
    new = Path(name)
    own = folder / f"{begun_ns:020d}-{time.time_ns():020d}-{os.getpid()}-{next(_numbers)}.ticket"
    try:
        with locked(new):
            new.write_text(holder, encoding="utf-8", errors="replace")
            new.rename(own)  # visible to others only when it is locked
            yield own
    finally:
        new.unlink(missing_ok=True)
        own.unlink(missing_ok=True)


def first_ahead(own: Path) -> str | None:
    """Return the holder of the first ticket of the queue that is older than `own`; None if there is none.

    Tickets whose process has ended are removed.
    """
    for other in sorted(own.parent.glob("*.ticket")):
        if other.name >= own.name:
            return None
        with locked(other, shared=True) as ended:
            if not ended:
                with suppress(OSError):  # its holder has just left the queue
                    return other.read_text(encoding="utf-8") or other.stem
        if ended:
            other.unlink(missing_ok=True)
    return None
