"""Lock on the output folder of a run: two runs never replace the same package at the same time."""

import hashlib
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from flows import home
from flows.engine import resources
from flows.packages.publish import is_current, leftovers, recover
from flows.processes import locked

POLL_S = 0.2  # between two attempts


@contextmanager
def output_lock(folder: Path, waiting: Callable[[], None]) -> Iterator[bool]:
    """Hold the lock of an output folder while the block runs; the kernel frees it when the process ends.

    Args:
        folder: where a package goes; it need not exist.
        waiting: called once if another run of this user holds the lock.

    Yields:
        True if another run held the lock before.

    Raises:
        Stopped: the user stopped the command meanwhile.
    """
    name = hashlib.sha256(os.fsencode(folder.absolute().resolve())).hexdigest()
    waited = False
    while True:
        with locked(home.locks() / f"output-{name}.lock") as free:
            if free:
                yield waited
                return
        if not waited:
            waited = True
            waiting()
        if resources.stopping.wait(POLL_S):
            raise resources.Stopped(f"stopped while another run writes {folder}")


def is_up_to_date(folder: Path, job_digest: str) -> bool:
    """Return True if a folder holds the unaltered package of a job; clean up after a run that was killed there.

    Raises:
        Stopped: the user stopped the command while another run wrote the folder.
    """
    if not is_current(folder, job_digest):
        return False
    if not leftovers(folder):
        return True
    with output_lock(folder, lambda: None):
        recover(folder)
        return is_current(folder, job_digest)
