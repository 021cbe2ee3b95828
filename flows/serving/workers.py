"""One Prefect worker for each work pool that this machine serves, in the background and started again when it ends.

`python -m flows.serving.workers POOL FOLDER API_URL` leaves a guard behind, which holds a lock on
FOLDER/worker-POOL.lock. It ends with the server whose state is in FOLDER, if that is the one at API_URL.
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
from flows.processes import die_with_parent, locked, python, start_of
from flows.serving.roots import SOURCES
from flows.serving.server import LOOK_S, Server, leave
from steps.store.files import write_atomically

RESTART_S = 5.0  # between two starts of a worker
GRACE_S = 10.0  # for a worker and its runs to end
QUERY_S = 2.0  # between two looks at the pool; Prefect's own is 10
LIMIT = "DG4D_WORKER_LIMIT"  # runs of a worker at a time
HEARTBEAT_S = 30  # of runs; what misses three of them is dead
RUN_VARIABLE = b"PREFECT__FLOW_RUN_ID="  # in the environment of the process of a run


class Worker:
    """The worker of a pool on this machine.

    Args:
        pool: its name.
        folder: of the server's state; the worker's lock and log are there too.
    """

    def __init__(self, pool: str, folder: Path) -> None:
        self.pool, self.folder = pool, folder

    @property
    def log(self) -> Path:
        """What the worker and its runs print."""
        return self.folder / f"worker-{self.pool}.log"

    def is_there(self) -> bool:
        """Whether its guard runs."""
        with locked(self._place("lock"), shared=True) as free:
            return not free

    @property
    def sources(self) -> str:
        """Places that its runs may read, as `$DG4D_SOURCES` had them when it was started; empty: never started."""
        place = self._place("sources")
        return place.read_text(encoding="utf-8") if place.exists() else ""

    def start(self, api_url: str, variables: Mapping[str, str] | None = None) -> None:
        """Start it with the environment of this process and these variables, unless it runs."""
        if self.is_there():
            return
        child = {**os.environ, **(variables or {})}
        write_atomically(self._place("sources"), child.get(SOURCES, ""))
        with self.log.open("wb") as log:
            subprocess.run(
                python("-m", "flows.serving.workers", self.pool, str(self.folder), api_url),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                cwd=self.folder,
                env=child,
                start_new_session=True,
                check=False,
            )

    def runs(self) -> int:
        """Return the number of runs that it executes at this moment."""
        with suppress(OSError, ValueError):  # it may just be ending
            guard = int(self._place("pid").read_text(encoding="ascii"))
            return sum(_is_run(child) for worker in _children(guard) for child in _children(int(worker)))
        return 0

    def stop(self) -> bool:
        """End it and the runs that it started; whether it was there."""
        if not self.is_there():
            return False
        deadline = time.monotonic() + 2 * GRACE_S
        while self.is_there() and time.monotonic() < deadline:
            with suppress(OSError, ValueError):  # it may just be starting, or ending
                os.kill(int(self._place("pid").read_text(encoding="ascii")), signal.SIGTERM)
            time.sleep(0.1)
        return True

    def guard(self, api_url: str) -> int:
        """Keep a worker running until told to stop, or until the server of this machine is gone, if it is of that."""
        with locked(self._place("lock"), patience_s=1.0) as alone:
            if not alone:
                return 0  # another guard was quicker
            signal.signal(signal.SIGTERM, leave)
            signal.signal(signal.SIGINT, lambda *_: None)  # SIG_IGN would be the worker's too, which ends by it
            self._place("pid").write_text(str(os.getpid()), encoding="ascii")
            server = Server(self.folder, self.folder)
            own = server.is_at(api_url)
            try:
                while server.is_guarded() or not own:
                    self._run(api_url, server if own else None)
                    time.sleep(RESTART_S)
            finally:
                self._place("pid").unlink(missing_ok=True)
            return 0

    def _run(self, api_url: str, server: Server | None) -> None:
        """Run a worker until it ends by itself, or the server of this machine does."""
        process = subprocess.Popen(
            python("-m", "prefect", "worker", "start", "--pool", self.pool, *_limited()),
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
            _end(process)

    def _place(self, suffix: str) -> Path:
        return self.folder / f"worker-{self.pool}.{suffix}"


def environment(api_url: str) -> dict[str, str]:
    """What a worker and its runs need to know."""
    return {
        "PREFECT_API_URL": api_url,
        "PYTHONSAFEPATH": "1",  # for the processes of runs too
        "PREFECT_WORKER_QUERY_SECONDS": f"{QUERY_S:g}",
        "PREFECT_FLOWS_HEARTBEAT_FREQUENCY": str(HEARTBEAT_S),
        "PREFECT_LOGGING_HANDLERS_CONSOLE_LEVEL": "INFO",
    }


def limit(per_worker: int | None) -> dict[str, str]:
    """Return the variable that limits the runs of a worker: `$DG4D_WORKER_LIMIT`, else the limit of its pool, if any.

    Raises:
        BadInput: the variable is not a number of runs.
    """
    given = os.environ.get(LIMIT) or str(per_worker or "")
    if given and not (given.isdecimal() and int(given) > 0):
        raise BadInput(f"${LIMIT} is {given!r}; set it to the number of runs that this machine executes at a time")
    return {LIMIT: given}


def running(folder: Path) -> list[Worker]:
    """The workers of this machine, by their pools."""
    workers = [Worker(lock.stem.removeprefix("worker-"), folder) for lock in sorted(folder.glob("worker-*.lock"))]
    return [worker for worker in workers if worker.is_there()]


def _limited() -> list[str]:
    """Return the option of a worker that limits its runs."""
    given = os.environ.get(LIMIT)
    return ["--limit", given] if given else []


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a worker, gently first, and every run that it started: each is a session of its own."""
    runs = {int(pid): start_of(int(pid)) for pid in _children(process.pid)}
    process.terminate()
    try:
        process.wait(GRACE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    for pid, start in runs.items():
        if start and start_of(pid) == start:
            with suppress(ProcessLookupError):
                os.killpg(pid, signal.SIGKILL)


def _children(pid: int) -> list[str]:
    """The processes that any thread of a process started."""
    found: list[str] = []
    for children in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(OSError):  # the thread has ended
            found += children.read_text(encoding="ascii").split()
    return found


def _is_run(pid: str) -> bool:
    """Return whether a process executes a flow run; a worker also starts short helpers."""
    with suppress(OSError):  # it has ended
        return RUN_VARIABLE in Path(f"/proc/{pid}/environ").read_bytes()
    return False


if __name__ == "__main__":
    if os.fork():
        os._exit(0)  # whoever started the guard does not wait for it
    sys.exit(Worker(sys.argv[1], Path(sys.argv[2])).guard(sys.argv[3]))
