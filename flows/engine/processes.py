"""Which process is which: a number, the moment it began, for numbers are used again, and where that number counts."""

import os
import socket
from pathlib import Path


def start_of(pid: int) -> str:
    """When a process began, in the kernel's ticks; empty if there is none."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace")
    except OSError:
        return ""
    return stat.rpartition(")")[2].split()[19]


def place() -> str:
    """The machine, or the container, whose processes this one sees; containers may have the name of their host."""
    try:
        return f"{socket.gethostname()}-{Path('/proc/self/ns/pid').stat().st_ino}"
    except OSError:  # no Linux
        return socket.gethostname()


OWN_START = start_of(os.getpid())
