"""Which process of this machine is which: a number and the moment it began, for numbers are used again."""

import os
from pathlib import Path


def start_of(pid: int) -> str:
    """When a process began, in the kernel's ticks; empty if there is none."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace")
    except OSError:
        return ""
    return stat.rpartition(")")[2].split()[19]


OWN_START = start_of(os.getpid())
