"""Temporary PostgreSQL server for measurements and tests, which can crash and restart."""

import os
import shutil
import socket
import subprocess
from pathlib import Path

from dg4d_lib.errors import BackendUnavailable


class Database:
    """Empty database, not started; owned by the user `postgres` if this process is root.

    Args:
        folder: empty, and readable by other users.

    Raises:
        BackendUnavailable: PostgreSQL is not installed.
    """

    def __init__(self, folder: Path) -> None:
        control, creator = _program("pg_ctl"), _program("initdb")
        self._user: list[str] = []
        if os.getuid() == 0:  # PostgreSQL refuses to run as root
            shutil.chown(folder, "postgres")
            self._user = ["setpriv", "--reuid=postgres", "--regid=postgres", "--clear-groups"]
        self._folder, self._port = folder, free_port()
        self._control = [control, "-D", str(folder / "data"), "-w", "-t", "300"]
        self._run(creator, "-D", str(folder / "data"), "-U", "prefect", "-A", "trust", "--no-sync")

    @property
    def address(self) -> str:
        """Return the address for a Prefect server."""
        return f"postgresql+asyncpg://prefect@127.0.0.1:{self._port}/postgres"

    def start(self) -> None:
        """Start the server and wait until it answers."""
        options = f"-p {self._port} -k {self._folder} -c listen_addresses=127.0.0.1"
        self._run(*self._control, "-l", str(self._folder / "log"), "-o", options, "start")

    def crash(self) -> None:
        """Kill the server without a shutdown; transactions in progress are lost."""
        self._run(*self._control, "-m", "immediate", "stop")

    def _run(self, *command: str) -> None:
        subprocess.run([*self._user, *command], check=True, stdout=subprocess.DEVNULL, cwd=self._folder)


def free_port() -> int:
    """Return a free port of this machine."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _program(name: str) -> str:
    """Return the path of a PostgreSQL program, which Debian does not put on PATH."""
    places = sorted(Path("/usr/lib/postgresql").glob(f"*/bin/{name}"))
    found = str(places[-1]) if places else shutil.which(name)
    if found is None:
        raise BackendUnavailable(f"PostgreSQL's {name} is not installed; on Debian run `apt-get install postgresql`")
    return found
