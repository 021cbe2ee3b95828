"""Background Prefect workers, one per work pool that this machine serves, restarted when they exit.

`python -m flows.serving.workers POOL FOLDER API_URL` detaches a guard, which locks FOLDER/worker-POOL.lock. It ends
with the server whose state is in FOLDER, if that is the one at API_URL.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from dg4d_lib.errors import BadInput
from flows.processes import die_with_parent, end, exit_guard, locked, python, spawn_guard, start_of
from flows.serving.roots import SOURCES
from flows.serving.server import LOOK_S, Server
from steps.store.files import write_atomically

RESTART_S = 5.0  # between exit and restart of a worker
GRACE_S = 10.0  # between SIGTERM and SIGKILL of a worker
QUERY_S = 2.0  # between two queries of the pool; Prefect's default is 10
LIMIT = "DG4D_WORKER_LIMIT"  # runs of a worker at a time
HEARTBEAT_S = 30  # of runs; `registering.py` marks a run as crashed when it misses three
RUN_VARIABLE = b"PREFECT__FLOW_RUN_ID="  # in the environment of a run's process


class Worker:
    """Worker of a pool on this machine.

    Args:
        pool: name of the pool.
        folder: folder of the server's state, and of the lock and log of the worker.
    """

    def __init__(self, pool: str, folder: Path) -> None:
        self.pool, self.folder = pool, folder

    @property
    def log(self) -> Path:
        """Output of the worker and its runs."""
        return self.folder / f"worker-{self.pool}.log"

    def is_running(self) -> bool:
        """Return true if its guard runs."""
        with locked(self._file("lock"), shared=True) as free:
            return not free

    @property
    def sources(self) -> str:
        """Value of `$DG4D_SOURCES` when the worker was started; empty if it never was."""
        file = self._file("sources")
        return file.read_text(encoding="utf-8") if file.exists() else ""

    def start(self, api_url: str, variables: Mapping[str, str] | None = None) -> None:
        """Start the worker unless it runs, with the environment of this process and these variables."""
        if self.is_running():
            return
        child = {**os.environ, **(variables or {})}
        write_atomically(self._file("sources"), child.get(SOURCES, ""))
        spawn_guard("flows.serving.workers", (self.pool, str(self.folder), api_url), self.log, "wb", child)

    def runs(self) -> int:
        """Return the number of its active runs."""
        with suppress(OSError, ValueError):  # the guard may be exiting
            guard = int(self._file("pid").read_text(encoding="ascii"))
            return sum(_is_run(child) for worker in _children(guard) for child in _children(int(worker)))
        return 0

    def stop(self) -> bool:
        """Stop the worker and its runs; return false if it was not running."""
        if not self.is_running():
            return False
        deadline = time.monotonic() + 2 * GRACE_S
        while self.is_running() and time.monotonic() < deadline:
            with suppress(OSError, ValueError):  # the guard may be starting or exiting
                os.kill(int(self._file("pid").read_text(encoding="ascii")), signal.SIGTERM)
            time.sleep(0.1)
        return True

    def guard(self, api_url: str) -> int:
        """Restart the worker until SIGTERM, or until the background server ends if the worker belongs to it."""
        with locked(self._file("lock"), patience_s=1.0) as alone:
            if not alone:
                return 0  # another guard was faster
            signal.signal(signal.SIGTERM, exit_guard)
            signal.signal(signal.SIGINT, lambda *_: None)  # the worker would inherit SIG_IGN, and SIGINT stops it
            self._file("pid").write_text(str(os.getpid()), encoding="ascii")
            server = Server(self.folder, self.folder)
            own = server.is_at(api_url)
            try:
                while server.is_guarded() or not own:
                    self._run(api_url, server if own else None)
                    time.sleep(RESTART_S)
            finally:
                self._file("pid").unlink(missing_ok=True)
            return 0

    def _run(self, api_url: str, server: Server | None) -> None:
        """Run a worker until it exits, or the background server ends."""
        limited = ("--limit", given) if (given := os.environ.get(LIMIT)) else ()
        process = subprocess.Popen(
            python("-m", "prefect", "worker", "start", "--pool", self.pool, *limited),
            env={**os.environ, **environment(api_url)},
            cwd=self.folder,
            start_new_session=True,
            preexec_fn=die_with_parent,  # noqa: PLW1509 - the guard has one thread
        )
        try:
            while server is None or server.is_guarded():
                with suppress(subprocess.TimeoutExpired):
                    process.wait(LOOK_S)
                    return
        finally:
            before = signal.signal(signal.SIGTERM, signal.SIG_IGN)  # it would interrupt the end of the runs
            _end(process)
            signal.signal(signal.SIGTERM, before)

    def _file(self, suffix: str) -> Path:
        return self.folder / f"worker-{self.pool}.{suffix}"


def environment(api_url: str) -> dict[str, str]:
    """Return the environment variables of a worker and its runs."""
    return {
        "PREFECT_API_URL": api_url,
        "PYTHONSAFEPATH": "1",  # as `-P`, for runs too
        "PREFECT_WORKER_QUERY_SECONDS": f"{QUERY_S:g}",
        "PREFECT_FLOWS_HEARTBEAT_FREQUENCY": str(HEARTBEAT_S),
        "PREFECT_LOGGING_HANDLERS_CONSOLE_LEVEL": "INFO",
        "PREFECT_LOGGING_INTERNAL_LEVEL": "ERROR",
    }


def limit(per_worker: int | None) -> dict[str, str]:
    """Return the variable that limits the runs of a worker: `$DG4D_WORKER_LIMIT`, else the limit of its pool, if any.

    Raises:
        BadInput: the variable is not a whole number from 1 on.
    """
    given = os.environ.get(LIMIT) or str(per_worker or "")
    if given and not (given.isdecimal() and int(given) > 0):
        raise BadInput(f"${LIMIT} is {given!r}; set it to the number of runs that this machine executes at a time")
    return {LIMIT: given}


def running(folder: Path) -> list[Worker]:
    """Return the running workers of this machine, sorted by pool."""
    workers = [Worker(lock.stem.removeprefix("worker-"), folder) for lock in sorted(folder.glob("worker-*.lock"))]
    return [worker for worker in workers if worker.is_running()]


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a worker, then kill its runs, which are sessions of their own."""
    runs = {int(pid): start_of(int(pid)) for pid in _children(process.pid)}
    end(process, GRACE_S)
    for pid, start in runs.items():
        if start and start_of(pid) == start:
            with suppress(ProcessLookupError):
                os.killpg(pid, signal.SIGKILL)


def _children(pid: int) -> list[str]:
    """Return the child processes of all threads of a process."""
    found: list[str] = []
    for children in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(OSError):  # the thread has ended
            found += children.read_text(encoding="ascii").split()
    return found


def _is_run(pid: str) -> bool:
    """Return true if a process executes a flow run; workers also start helper processes."""
    with suppress(OSError):  # it has ended
        return RUN_VARIABLE in Path(f"/proc/{pid}/environ").read_bytes()
    return False


if __name__ == "__main__":
    if os.fork():
        os._exit(0)  # the caller waits for this process only
    sys.exit(Worker(sys.argv[1], Path(sys.argv[2])).guard(sys.argv[3]))
