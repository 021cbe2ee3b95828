"""Which process is which, which one is alone with a file, which ends with another, and what it has from us."""

import ctypes
import fcntl
import os
import signal
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def start_of(pid: int) -> str:
    """When a process began, in the kernel's ticks, for numbers are used again; empty if there is none."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace")
    except OSError:
        return ""
    return stat.rpartition(")")[2].split()[19]


def host_id() -> str:
    """Return the identity of the machine, or container, whose processes this one sees.

    It is `$DG4D_HOST_ID`, else host name and PID namespace: containers may share the name of their host.
    """
    if given := os.environ.get("DG4D_HOST_ID"):
        return given
    try:
        return f"{socket.gethostname()}-{Path('/proc/self/ns/pid').stat().st_ino}"
    except OSError:  # no Linux
        return socket.gethostname()


def python(*arguments: str) -> list[str]:
    """Return the command line of a Python child that imports nothing from the current folder (`-P`)."""
    return [sys.executable, "-P", *arguments]


def without_prefect() -> dict[str, str]:
    """The environment, for a process that is to have none of Prefect's settings, or its own."""
    return {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}


def die_with_parent() -> None:
    """Have the kernel end this process when the one that started it ends, however it does."""
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


@contextmanager
def locked(path: Path, *, shared: bool = False, patience_s: float = 0.0) -> Iterator[bool]:
    """Hold the lock of a file while the block runs; gives whether it could be had.

    Args:
        path: of the file; it is made.
        shared: only look whether somebody holds it alone, and disturb nobody who also looks.
        patience_s: seconds to try, for those who look hold it for a moment too.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    deadline = time.monotonic() + patience_s
    with path.open("a") as file:
        while True:
            try:
                fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
            except BlockingIOError:
                if time.monotonic() < deadline:
                    time.sleep(0.02)
                    continue
                yield False
                return
            yield True
            return


OWN_START = start_of(os.getpid())
