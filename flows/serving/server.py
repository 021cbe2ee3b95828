"""Background Prefect server, shared by all commands of a user; it ends when it was not used for a while.

`python -m flows.serving.server FOLDER PREFECT_HOME` detaches a guard, which starts the server, writes its address to
FOLDER/server.json and watches it. The server listens on the loopback interface only and asks for the secret in
FOLDER/auth. A command holds a shared lock on FOLDER/in-use while it runs, which the kernel frees at its end.
"""

import fcntl
import http.client
import json
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import IO
from urllib.parse import quote

from dg4d_lib.errors import BadInput
from flows.processes import die_with_parent, end, exit_guard, locked, python, spawn_guard, without_prefect
from flows.serving import auth, database_template
from steps.store.files import write_atomically

HOST = "127.0.0.1"  # never another interface: the traffic is not encrypted
LOGIN = "/dg4d/login"
START_TIMEOUT_S = 120.0
STARTS = 3  # attempts with a server that exits
GUARD_START_S = 20.0  # start of a bare interpreter
IDLE = "DG4D_SERVER_IDLE_S"  # variable: seconds without a command before the server ends
IDLE_S = 1800.0  # its default
LOOK_S = 1.0  # between two checks of the guard
GRACE_S = 8.0  # between SIGTERM and SIGKILL

SETTINGS = {
    "DO_NOT_TRACK": "1",
    "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
    "PREFECT_SERVER_CSRF_PROTECTION_ENABLED": "true",
    "PREFECT_SERVER_UI_API_URL": "/api",  # relative: whatever the port
    "PREFECT_SERVER_UI_SHOW_PROMOTIONAL_CONTENT": "false",
    "PREFECT_SERVER_LOGGING_LEVEL": "WARNING",
    # one database file for a server and a few clients: write in batches
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_BATCH_SIZE": "200",
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_READ_BATCH_SIZE": "200",
    "PREFECT_SERVER_SERVICES_TASK_RUN_RECORDER_FLUSH_INTERVAL": "1",
    "PREFECT_SERVER_SERVICES_EVENT_PERSISTER_BATCH_SIZE": "500",
    "PREFECT_SERVER_SERVICES_EVENT_PERSISTER_READ_BATCH_SIZE": "200",
    # slots of a killed run become free, also after a restart of the server
    "PREFECT_SERVER_CONCURRENCY_LEASE_STORAGE": "prefect.server.concurrency.lease_storage.filesystem",
    # a killed run is resumed after a restart
    "PREFECT_SERVER_EVENTS_CAUSAL_ORDERING": "flows.prefect_compat",
}


class ServerUnavailable(Exception):
    """Server that cannot be started or does not answer; the message names its log."""


class Server:
    """Background server whose state is in `folder`.

    Args:
        folder: folder of lock files, log and `server.json`.
        prefect_home: folder of the database; the PREFECT_HOME of the server.
    """

    def __init__(self, folder: Path, prefect_home: Path) -> None:
        self.folder, self.prefect_home = folder, prefect_home
        self._in_use: IO[str] | None = None

    @property
    def log(self) -> Path:
        """Output of the server and its guard."""
        return self.folder / "server.log"

    def start(self) -> None:
        """Start the server in the background unless it runs; it stays while this process uses it.

        Raises:
            BadInput: `$DG4D_SERVER_IDLE_S` is not a number of seconds.
        """
        _idle_s()  # its error would end the guard, which has only a log
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.auth_string()  # creates the secret
        if self._in_use is None:
            self._in_use = (self.folder / "in-use").open("a+")
            fcntl.flock(self._in_use, fcntl.LOCK_SH)  # waits for a guard that is ending its server
        if not self.is_guarded():
            arguments = (str(self.folder), str(self.prefect_home))
            spawn_guard("flows.serving.server", arguments, self.log, "ab", os.environ)

    def has_database(self) -> bool:
        """Return true if the server ran before, so that its next start creates no database."""
        return (self.prefect_home / database_template.NAME).exists()

    def auth_string(self) -> str:
        """Return the secret that the server asks for, NAME:PASSWORD."""
        return auth.auth_string(self.folder)

    def login_address(self, address: str, then: str = "") -> str:
        """Return the address that signs a browser in; what follows "#" is not sent over the network.

        Args:
            address: of the server.
            then: path of the page that follows; empty: Prefect's.
        """
        return f"{address}{LOGIN}{f'?next={then}' if then else ''}#{quote(self.auth_string(), safe=':')}"

    def wait_for_address(self) -> str:
        """Return the address of the server, which is known before it answers.

        Raises:
            ServerUnavailable: the guard did not start.
        """
        deadline = time.monotonic() + GUARD_START_S
        while time.monotonic() < deadline:
            if (address := self.address()) is not None:
                return address
            time.sleep(0.02)
        self.release()
        raise ServerUnavailable(f"the guard of the Prefect server did not start; see {self.log}")

    def wait(self, timeout_s: float = START_TIMEOUT_S) -> str:
        """Wait until the server answers; return the address of its API.

        Raises:
            ServerUnavailable: it did not answer within `timeout_s`, or exited.
        """
        deadline = time.monotonic() + timeout_s
        starts = 1
        while time.monotonic() < deadline:
            if (address := self.address()) is not None and answers(address, timeout_s=5.0):
                return f"{address}/api"
            if not self.is_guarded():
                if starts == STARTS:
                    break
                starts += 1
                self.start()
            time.sleep(0.1)
        self.release()
        raise ServerUnavailable(
            f"the Prefect server did not answer within {timeout_s:g} s; see {self.log}. "
            "Set PREFECT_API_URL to use a server of your own."
        )

    def address(self) -> str | None:
        """Return the address of the server, also while it starts; None if it does not run."""
        state = self._state()
        return f"http://{HOST}:{state['port']}" if state and self.is_guarded() else None

    def is_at(self, api_url: str) -> bool:
        """Return true if this is the present or last address of its API."""
        try:
            return api_url == f"http://{HOST}:{(self.folder / 'port').read_text(encoding='ascii')}/api"
        except OSError:
            return False

    def keep(self) -> None:
        """Keep the server running when no command uses it."""
        (self.folder / "keep").touch()

    def stop(self, timeout_s: float = 20.0) -> bool:
        """Stop the server; return false if it was not running.

        Raises:
            ServerUnavailable: it still runs after `timeout_s`.
        """
        (self.folder / "keep").unlink(missing_ok=True)
        state = self._state()
        if not self.is_guarded() or state is None:
            return False
        with suppress(ProcessLookupError):
            os.kill(state["guard"], signal.SIGTERM)
        deadline = time.monotonic() + timeout_s
        while self.is_guarded():
            if time.monotonic() > deadline:
                raise ServerUnavailable(f"process {state['guard']} did not end; see {self.log}")
            time.sleep(0.05)
        return True

    def release(self) -> None:
        """Stop using the server in this process."""
        if self._in_use is not None:
            self._in_use.close()
            self._in_use = None

    def _state(self) -> dict[str, int] | None:
        try:
            state = json.loads((self.folder / "server.json").read_text(encoding="utf-8"))
            return {"guard": int(state["guard"]), "port": int(state["port"])}
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def is_used(self) -> bool:
        """Return true if a command uses the server."""
        with locked(self.folder / "in-use") as unused:
            return not unused

    def is_guarded(self) -> bool:
        """Return true if its guard runs."""
        with locked(self.folder / "guard", shared=True) as free:
            return not free


def answers(address: str, timeout_s: float) -> bool:
    """Return true if a Prefect server at `address` reports that it is healthy."""
    host, _, port = address.removeprefix("http://").partition(":")
    connection = http.client.HTTPConnection(host, int(port), timeout=timeout_s)
    try:
        connection.request("GET", "/api/health")
        return connection.getresponse().status == http.client.OK
    except (OSError, http.client.HTTPException):
        return False
    finally:
        connection.close()


def guard(folder: Path, prefect_home: Path) -> int:
    """Run the server until it is stopped, exits, or is idle for `$DG4D_SERVER_IDLE_S`."""
    with locked(folder / "guard", patience_s=1.0) as alone:
        if not alone:
            return 0  # another guard was faster
        state = folder / "server.json"
        state.unlink(missing_ok=True)
        os.truncate(folder / "server.log", 0)
        idle_s = _idle_s()
        listener = _listener(state)
        port = int(listener.getsockname()[1])
        process = _serve(listener, folder, prefect_home)
        signal.signal(signal.SIGTERM, exit_guard)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            write_atomically(state, json.dumps({"guard": os.getpid(), "port": port}))
            return _watch(process, folder, idle_s)
        finally:
            state.unlink(missing_ok=True)
            end(process, GRACE_S)


def _idle_s() -> float:
    """Return the time without a command before the server ends.

    Raises:
        BadInput: the variable is not a number of seconds from 0 on.
    """
    given = os.environ.get(IDLE, "")
    with suppress(ValueError):
        if (seconds := float(given or IDLE_S)) >= 0:  # false for NaN
            return seconds
    raise BadInput(f"${IDLE} is {given!r}; set it to a number of seconds from 0 on, such as {IDLE_S:g}")


def _watch(process: subprocess.Popen[bytes], folder: Path, idle_s: float) -> int:
    """Return when the server has exited, or was ended because no command used it for `idle_s` seconds."""
    last_use = time.monotonic()
    while True:
        with suppress(subprocess.TimeoutExpired):
            return process.wait(LOOK_S)
        if (folder / "keep").exists():
            last_use = time.monotonic()
            continue
        with locked(folder / "in-use") as unused:  # until the server has ended, so that new commands wait for that
            if not unused:
                last_use = time.monotonic()
            elif time.monotonic() - last_use > idle_s:
                (folder / "server.json").unlink(missing_ok=True)
                end(process, GRACE_S)
                return 0


def _serve(listener: socket.socket, folder: Path, prefect_home: Path) -> subprocess.Popen[bytes]:
    prefect_home.mkdir(mode=0o700, parents=True, exist_ok=True)
    database_template.copy_to(prefect_home)
    port = listener.getsockname()[1]
    environment = {
        **without_prefect(),
        **SETTINGS,
        "PREFECT_HOME": str(prefect_home),
        "PREFECT_SERVER_DATABASE_CONNECTION_URL": database_template.address(prefect_home),
        "PREFECT_SERVER_API_AUTH_STRING": auth.auth_string(folder),
        "PREFECT_SERVER_REGISTER_BLOCKS_ON_START": str(not database_template.has_block_types(prefect_home)).lower(),
        "PREFECT_SERVER_CORS_ALLOWED_ORIGINS": f"http://{HOST}:{port}",
    }
    return subprocess.Popen(
        python("-m", "flows.serving.server_program", str(listener.fileno())),
        env=environment,
        cwd=prefect_home,
        pass_fds=[listener.fileno()],
        preexec_fn=die_with_parent,  # noqa: PLW1509 - the guard has one thread
    )


def _listener(state: Path) -> socket.socket:
    """Listen on the last port, so that addresses stay valid, or else on a free one.

    The guard listens before the server starts and keeps the socket, so no other process can take the port and receive
    the secret meanwhile. A port that is only bound can be taken: SO_REUSEADDR lets another user bind it too and listen.
    """
    before = 0
    with suppress(OSError, ValueError):
        before = int((state.parent / "port").read_text(encoding="ascii"))
    for port in (before, 0):
        listener = socket.socket()
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((HOST, port))
            listener.listen()  # connections wait until the server accepts them
        except (OSError, OverflowError):
            listener.close()
            continue
        (state.parent / "port").write_text(str(listener.getsockname()[1]), encoding="ascii")
        return listener
    raise ServerUnavailable(f"no port is free on {HOST}: end other programs")


if __name__ == "__main__":
    if os.fork():
        os._exit(0)  # the caller waits for this process only
    sys.exit(guard(Path(sys.argv[1]), Path(sys.argv[2])))
