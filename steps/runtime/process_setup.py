"""Set-up of a step's process: memory allocator, threads, lifetime and resource usage."""

import ctypes
import faulthandler
import gc
import os
import resource
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from steps.contract import EXIT_CRASHED

M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_MAX = -1, -2, -4  # parameters of glibc's mallopt
PR_SET_PDEATHSIG = 1  # option of Linux's prctl


def prepare_process() -> None:
    """Set environment and allocator before torch is imported; print a traceback when native code crashes."""
    faulthandler.enable(all_threads=False)
    signal.signal(signal.SIGABRT, signal.SIG_DFL)  # aborting libraries print a reason, which a traceback would hide
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # torch's threads would spin after every operation
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # NumPy's threads would spin too, and its matrices are small
    if not sys.platform.startswith("linux"):
        return
    try:  # keep freed memory, so that large temporaries are not mapped anew in every operation
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # not glibc
        return
    mallopt(M_MMAP_MAX, 0)
    mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
    mallopt(M_TOP_PAD, 256 * 2**20)


@contextmanager
def garbage_collection_paused() -> Iterator[None]:
    """Collect no garbage in the block, and none of its objects later: this saves a quarter of the time of imports."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if enabled:
            gc.enable()


def set_process_name(name: str) -> None:
    """Set the name that `top` and `ps` show."""
    with suppress(OSError):  # not Linux
        Path("/proc/self/comm").write_text(name, encoding="ascii")


def die_with(parent: str) -> None:
    """Exit with a parent process, given by its id; "-" exits when standard input is closed.

    In a container, "-" replaces the id of the parent, which runs outside. Its other processes end with this one.
    """
    if parent == "-":
        threading.Thread(target=_end_with_input, daemon=True).start()
        return
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != int(parent):  # it ended before the line above
        sys.exit(EXIT_CRASHED)


def _end_with_input() -> None:
    while os.read(0, 1):
        pass
    os._exit(EXIT_CRASHED)


def cpu_seconds() -> float:
    """Return the CPU time of this process and of its children that have ended, in seconds of all cores."""
    used = (resource.getrusage(whose) for whose in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(times.ru_utime + times.ru_stime for times in used)


def peak_memory_mb() -> float:
    """Return the peak resident memory of this process, in MiB."""
    try:  # getrusage would include the program that ran in this process before exec
        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        return int(status.split("VmHWM:")[1].split()[0]) / 1024
    except (OSError, IndexError):  # not Linux
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / (1024 * 1024 if sys.platform == "darwin" else 1024)
