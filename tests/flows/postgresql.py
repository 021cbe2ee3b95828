"""A Prefect server on PostgreSQL for a test; the database may crash and come back."""

import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from flows.server import SETTINGS, answers

START_S = 400.0  # on a machine that is busy with other things


def program(name: str) -> str:
    """Of PostgreSQL, which Debian does not put on the path; skips the test where it is not installed."""
    places = sorted(Path("/usr/lib/postgresql").glob(f"*/bin/{name}"))
    found = str(places[-1]) if places else shutil.which(name)
    if found is None:
        pytest.skip("PostgreSQL is not here (Debian: apt-get install postgresql)")
    return found


class Database:
    """An empty database of its own.

    Args:
        folder: where it lies, an empty one that others may look into.
    """

    def __init__(self, folder: Path) -> None:
        control = program("pg_ctl")
        self._user: list[str] = []
        if os.getuid() == 0:  # it does not run as root
            shutil.chown(folder, "postgres")
            self._user = ["setpriv", "--reuid=postgres", "--regid=postgres", "--clear-groups"]
        self._folder, self._port = folder, free_port()
        self._control = [control, "-D", str(folder / "data"), "-w", "-t", "300"]
        self._run(program("initdb"), "-D", str(folder / "data"), "-U", "prefect", "-A", "trust", "--no-sync")

    @property
    def address(self) -> str:
        """For a Prefect server."""
        return f"postgresql+asyncpg://prefect@127.0.0.1:{self._port}/postgres"

    def start(self) -> None:
        """Start it, and wait until it answers."""
        options = f"-p {self._port} -k {self._folder} -c listen_addresses=127.0.0.1"
        self._run(*self._control, "-l", str(self._folder / "log"), "-o", options, "start")

    def crash(self) -> None:
        """End it as a crash does: nobody is told, what is under way is lost."""
        self._run(*self._control, "-m", "immediate", "stop")

    def _run(self, *command: str) -> None:
        subprocess.run([*self._user, *command], check=True, stdout=subprocess.DEVNULL, cwd=self._folder)


@contextmanager
def server_on_postgresql(prefect_home: Path) -> Iterator[tuple[str, Database]]:
    """The product's Prefect server on a database of its own; where its API is.

    The database lies outside of the folders of pytest, which are closed to other users.
    """
    with tempfile.TemporaryDirectory(prefix="dg4d-postgresql-") as folder:
        database = Database(Path(folder))
        database.start()
        port = free_port()
        server = subprocess.Popen(
            [sys.executable, "-m", "uvicorn", "--factory", "flows.server_app:create_app", "--port", str(port),
             "--log-level", "critical"],
            env={
                **os.environ,
                **SETTINGS,
                "PREFECT_HOME": str(prefect_home),
                "PREFECT_API_DATABASE_CONNECTION_URL": database.address,
            },
        )  # fmt: skip
        try:
            deadline = time.monotonic() + START_S
            while not answers(f"http://127.0.0.1:{port}", timeout_s=5.0):
                assert server.poll() is None and time.monotonic() < deadline, "the server did not start"
                time.sleep(0.3)
            yield f"http://127.0.0.1:{port}/api", database
        finally:
            server.terminate()
            server.wait(60)
            database.crash()


def free_port() -> int:
    """A port of this machine that nobody uses."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
