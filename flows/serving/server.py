"""Prefect server in the background, shared by all commands of a user; it ends when nobody has used it for a while.

`python -m flows.serving.server FOLDER PREFECT_HOME` leaves a guard behind: it starts the server, writes its address to
FOLDER/server.json, and watches it. The server listens on the loopback interface only and asks for the secret in
FOLDER/auth.
Commands hold a shared lock on FOLDER/in-use while they run; the kernel frees it when they end, however they end.
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
from types import FrameType
from typing import IO
from urllib.parse import quote

from flows.processes import die_with_parent, locked, python, without_prefect
from flows.serving import auth, database_template

HOST = "127.0.0.1"  # never another interface: the traffic is not encrypted
LOGIN = "/dg4d/login"
START_TIMEOUT_S = 120.0
STARTS = 3  # before giving up on a server that ends
GUARD_START_S = 20.0  # a bare interpreter
IDLE_S = 1800.0  # without a command before the server ends; $DG4D_SERVER_IDLE_S
LOOK_S = 1.0  # between two looks of the guard

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
    # a slot that a killed run held is free again, also after the server was started anew
    "PREFECT_SERVER_CONCURRENCY_LEASE_STORAGE": "prefect.server.concurrency.lease_storage.filesystem",
    # and a run that was killed goes on then
    "PREFECT_SERVER_EVENTS_CAUSAL_ORDERING": "flows.prefect_compat",
}


class ServerUnavailable(Exception):
    """The server could not be started, or did not answer; says where its log is."""


class Server:
    """The background server whose state is in `folder`.

    Args:
        folder: of the lock files, the log and `server.json`.
        prefect_home: of the database; handed to the server as PREFECT_HOME.
    """

    def __init__(self, folder: Path, prefect_home: Path) -> None:
        self.folder, self.prefect_home = folder, prefect_home
        self._in_use: IO[str] | None = None

    @property
    def log(self) -> Path:
        """What the server and its guard print."""
        return self.folder / "server.log"

    def start(self) -> None:
        """Start it unless it runs, without waiting for it. From here on this command counts as a user."""
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.auth_string()  # before anything can ask for it
        if self._in_use is None:
            self._in_use = (self.folder / "in-use").open("a")
            fcntl.flock(self._in_use, fcntl.LOCK_SH)  # waits for a guard that is just ending its server
        if not self.is_guarded():
            with self.log.open("ab") as log:
                subprocess.run(
                    python("-m", "flows.serving.server", str(self.folder), str(self.prefect_home)),
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    cwd=self.folder,
                    start_new_session=True,
                    umask=0o077,  # the database and the logs have what users asked for
                    check=False,
                )

    def auth_string(self) -> str:
        """Return the secret that the server asks for, NAME:PASSWORD."""
        return auth.auth_string(self.folder)

    def login_address(self, address: str) -> str:
        """Return the address that signs a browser in; what follows "#" is not sent over the network."""
        return f"{address}{LOGIN}#{quote(self.auth_string(), safe=':')}"

    def wait_for_address(self) -> str:
        """Where it will be; known before it answers.

        Raises:
            ServerUnavailable: its guard did not start.
        """
        deadline = time.monotonic() + GUARD_START_S
        while time.monotonic() < deadline:
            if (address := self.address()) is not None:
                return address
            time.sleep(0.02)
        self.release()
        raise ServerUnavailable(f"the guard of the Prefect server did not start; what it said is in {self.log}")

    def wait(self, timeout_s: float = START_TIMEOUT_S) -> str:
        """Wait until it answers; the address of its API.

        Raises:
            ServerUnavailable: it did not within `timeout_s`, or it ended.
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
            f"the Prefect server did not answer within {timeout_s:g} s; what it said is in {self.log}. "
            "Set PREFECT_API_URL to use a server of your own."
        )

    def address(self) -> str | None:
        """Where it is, or will be when it has started; None when it does not run."""
        state = self._state()
        return f"http://{HOST}:{state['port']}" if state and self.is_guarded() else None

    def is_at(self, api_url: str) -> bool:
        """Whether this is the address of its API, or was when it last ran."""
        try:
            return api_url == f"http://{HOST}:{(self.folder / 'port').read_text(encoding='ascii')}/api"
        except OSError:
            return False

    def keep(self) -> None:
        """Do not end it for want of users."""
        (self.folder / "keep").touch()

    def stop(self, timeout_s: float = 20.0) -> bool:
        """End it; whether it was running.

        Raises:
            ServerUnavailable: it is still there after `timeout_s`.
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
        """This command does not use it any more."""
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
        """Return whether a command uses it."""
        with locked(self.folder / "in-use") as unused:
            return not unused

    def is_guarded(self) -> bool:
        """Whether its guard is there: it runs, or starts."""
        with locked(self.folder / "guard", shared=True) as free:
            return not free


def answers(address: str, timeout_s: float) -> bool:
    """Whether a Prefect server at `address` says that it is well."""
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
    """Run the server until it is told to stop, ends by itself, or nobody uses it."""
    with locked(folder / "guard", patience_s=1.0) as alone:
        if not alone:
            return 0  # another guard was quicker
        state = folder / "server.json"
        state.unlink(missing_ok=True)
        os.truncate(folder / "server.log", 0)
        idle_s = float(os.environ.get("DG4D_SERVER_IDLE_S", IDLE_S))
        listener = _listener(state)
        port = int(listener.getsockname()[1])
        process = _serve(listener, folder, prefect_home)
        signal.signal(signal.SIGTERM, leave)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            scratch = state.with_suffix(".new")
            scratch.write_text(json.dumps({"guard": os.getpid(), "port": port}), encoding="utf-8")
            scratch.replace(state)
            return _watch(process, folder, idle_s)
        finally:
            state.unlink(missing_ok=True)
            end(process)


def _watch(process: subprocess.Popen[bytes], folder: Path, idle_s: float) -> int:
    last_use = time.monotonic()
    while True:
        try:
            return process.wait(LOOK_S)
        except subprocess.TimeoutExpired:
            pass
        if (folder / "keep").exists():
            last_use = time.monotonic()
            continue
        with locked(folder / "in-use") as unused:
            if not unused:
                last_use = time.monotonic()
            elif time.monotonic() - last_use > idle_s:
                (folder / "server.json").unlink(missing_ok=True)
                end(process)
                return 0


def _serve(listener: socket.socket, folder: Path, prefect_home: Path) -> subprocess.Popen[bytes]:
    prefect_home.mkdir(mode=0o700, parents=True, exist_ok=True)
    database_template.copy_to(prefect_home)
    port = listener.getsockname()[1]
    environment = {
        **without_prefect(),
        **SETTINGS,
        "PREFECT_HOME": str(prefect_home),
        "PREFECT_SERVER_API_AUTH_STRING": auth.auth_string(folder),
        "PREFECT_SERVER_CORS_ALLOWED_ORIGINS": f"http://{HOST}:{port}",
    }
    return subprocess.Popen(
        python("-m", "flows.serving.server_app", str(listener.fileno())),
        env=environment,
        cwd=prefect_home,
        pass_fds=[listener.fileno()],
        preexec_fn=die_with_parent,  # noqa: PLW1509 - the guard has one thread
    )


def end(process: subprocess.Popen[bytes]) -> None:
    """End a process, gently first."""
    process.terminate()
    try:
        process.wait(8.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def leave(number: int, frame: FrameType | None) -> None:
    """What a guard does when it is told to stop."""
    sys.exit(0)


def _listener(state: Path) -> socket.socket:
    """Bind the port of last time, so that addresses stay, or one that is free.

    The guard keeps the socket: nobody else can take the port and be asked for the secret while the server starts.
    """
    before = 0
    with suppress(OSError, ValueError):
        before = int((state.parent / "port").read_text(encoding="ascii"))
    for port in (before, 0):
        listener = socket.socket()
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((HOST, port))
        except (OSError, OverflowError):
            listener.close()
            continue
        (state.parent / "port").write_text(str(listener.getsockname()[1]), encoding="ascii")
        return listener
    raise ServerUnavailable(f"No port is free on {HOST}.")


if __name__ == "__main__":
    if os.fork():
        os._exit(0)  # whoever started the guard does not wait for it
    sys.exit(guard(Path(sys.argv[1]), Path(sys.argv[2])))
