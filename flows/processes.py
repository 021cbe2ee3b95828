"""Process identity, file locks, signals that are not lost, child environments and background guards."""

import ctypes
import fcntl
import functools
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

REMINDER_S = 3.0  # after which a signal is sent again


def start_of(pid: int) -> str:
    """Return the start time of a process in kernel ticks, since PIDs are reused; empty if there is no such process."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace")
    except OSError:
        return ""
    return stat.rpartition(")")[2].split()[19]


def host_id() -> str:
    """Return `$DG4D_HOST_ID`, else host name and PID namespace: containers may share the name of their host."""
    return os.environ.get("DG4D_HOST_ID") or _host_and_namespace()


@functools.cache  # the host name may change while a process runs, its identity may not
def _host_and_namespace() -> str:
    try:
        return f"{socket.gethostname()}-{Path('/proc/self/ns/pid').stat().st_ino}"
    except OSError:  # no Linux
        return socket.gethostname()


def python(*arguments: str) -> list[str]:
    """Return the command line of a Python child that imports nothing from the current folder (`-P`)."""
    return [sys.executable, "-P", *arguments]


def without_prefect() -> dict[str, str]:
    """Return the environment without Prefect's settings."""
    return {name: value for name, value in os.environ.items() if not name.startswith("PREFECT_")}


def die_with_parent() -> None:
    """Have the kernel kill this process when its parent ends."""
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG


@contextmanager
def locked(path: Path, *, shared: bool = False, patience_s: float = 0.0) -> Iterator[bool]:
    """Lock a file while the block runs; yield false if another process holds the lock.

    Args:
        path: path of the file; created if missing.
        shared: take a shared lock, to see if another process holds an exclusive one.
        patience_s: seconds to retry, since readers hold a shared lock briefly.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    deadline = time.monotonic() + patience_s
    with path.open("a+") as file:  # NFS refuses shared locks on a descriptor that cannot read
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


def spawn_guard(module: str, arguments: Sequence[str], log: Path, mode: str, env: Mapping[str, str]) -> None:
    """Start `python -m MODULE`, which detaches a background process and exits.

    Args:
        module: forks, and exits in the parent.
        arguments: command line arguments.
        log: file for its output, in the folder that becomes its current one.
        mode: "ab" to append to the log, "wb" to truncate it.
        env: environment variables.
    """
    with log.open(mode) as output:
        subprocess.run(
            python("-m", module, *arguments),
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            cwd=log.parent,
            env=env,
            start_new_session=True,
            umask=0o077,  # database and logs contain user input
            check=False,
        )


def end(process: subprocess.Popen[bytes], grace_s: float) -> None:
    """Terminate a process; kill it after `grace_s` seconds."""
    process.terminate()
    try:
        process.wait(grace_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def exit_guard(number: int, frame: FrameType | None) -> None:
    """Handle SIGTERM in a guard: exit, with its `finally` clauses, which no further SIGTERM interrupts."""
    signal.signal(number, signal.SIG_IGN)
    sys.exit(0)


OWN_START = start_of(os.getpid())


@contextmanager
def repeated(number: signal.Signals) -> Iterator[None]:
    """Repeat a signal until the block has ended, since the exception of its handler may be lost; see `start_reminder`.

    Outside of the main thread, and for signals without a handler, nothing changes.
    """
    handler = signal.getsignal(number)
    if not callable(handler) or threading.current_thread() is not threading.main_thread():
        yield
        return
    ended, received = threading.Event(), threading.Event()
    restoring = threading.Lock()  # no reminder once the handler is back

    def handle(given: int, frame: FrameType | None) -> None:
        if not received.is_set():
            received.set()
            start_reminder(number, ended, restoring)
        handler(given, frame)

    signal.signal(number, handle)
    try:
        yield
    finally:
        with restoring:
            ended.set()
        signal.signal(number, handler)


def start_reminder(number: signal.Signals, ended: threading.Event, restoring: threading.Lock) -> None:
    """Send a signal to this thread every `REMINDER_S` seconds until `ended`, never while `restoring` is held.

    An exception that a handler raises within a finalizer or a callback of C code is lost.
    """
    thread = threading.get_ident()

    def remind() -> None:
        while not ended.wait(REMINDER_S):
            with restoring:
                if not ended.is_set():
                    signal.pthread_kill(thread, number)

    threading.Thread(target=remind, daemon=True).start()
