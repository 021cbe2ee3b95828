"""A PostgreSQL server of one's own, for measurements and tests; it may crash and come back."""

import os
import shutil
import socket
import subprocess
from pathlib import Path

from dg4d_lib.errors import BackendUnavailable


class Database:
    """An empty database, not started; under the user `postgres` where this one is root.

    Args:
        folder: where it lies, an empty one that others may look into.

    Raises:
        BackendUnavailable: PostgreSQL is not installed.
    """

    def __init__(self, folder: Path) -> None:
        control, creator = _program("pg_ctl"), _program("initdb")
        self._user: list[str] = []
        if os.getuid() == 0:  # it does not run as root
            shutil.chown(folder, "postgres")
            self._user = ["setpriv", "--reuid=postgres", "--regid=postgres", "--clear-groups"]
        self._folder, self._port = folder, free_port()
        self._control = [control, "-D", str(folder / "data"), "-w", "-t", "300"]
        self._run(creator, "-D", str(folder / "data"), "-U", "prefect", "-A", "trust", "--no-sync")

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


def free_port() -> int:
    """A port of this machine that nobody uses."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _program(name: str) -> str:
    """Of PostgreSQL, which Debian does not put on the path."""
    places = sorted(Path("/usr/lib/postgresql").glob(f"*/bin/{name}"))
    found = str(places[-1]) if places else shutil.which(name)
    if found is None:
        raise BackendUnavailable(f"PostgreSQL's {name} is not here; on Debian: apt-get install postgresql")
    return found
