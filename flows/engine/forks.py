"""Processes of steps, forked from one that has imported what they need (`steps/runtime/fork_server.py`)."""

import atexit
import json
import os
import queue
import signal
import socket
import subprocess
import threading
from collections.abc import Sequence
from concurrent.futures import Future
from typing import IO, BinaryIO

from flows.engine.processes import python, without_prefect
from steps.runtime.fork_server import ORDER_BYTES

SET_BY_IMPORTS = "OpenImageIO_ROOT"  # by a library, for its own programs
ATTEMPTS = 2  # a server may have been killed since its last step


def prepare() -> None:
    """Have the imports of steps begin now, so that the first step need not wait for them."""
    _server()


class Fork:
    """A step's process, as `subprocess.Popen` shows one.

    Attributes:
        pid: of the process and of its group.
        stdin: it lives as long as this is open, if it was told so.
        stdout: what it prints.
    """

    def __init__(self, pid: int, status: Future[int], stdin: IO[str], stdout: IO[str]) -> None:
        self.pid, self.stdin, self.stdout, self._status = pid, stdin, stdout, status

    def poll(self) -> int | None:
        """Its exit status, or the negative number of a signal; nothing while it runs."""
        return self._status.result() if self._status.done() else None

    def wait(self, timeout: float | None = None) -> int:
        """Its exit status, or the negative number of a signal.

        Raises:
            TimeoutError: it still runs after so many seconds.
        """
        return self._status.result(timeout)


def fork(
    arguments: Sequence[str], environment: dict[str, str], stderr: BinaryIO, handles: Sequence[int]
) -> Fork | None:
    """Begin a step, with what `ForkServer.fork` is told; nothing if no server stays alive for it."""
    for _ in range(ATTEMPTS):
        if (begun := _server().fork(arguments, environment, stderr, handles)) is not None:
            return begun
    return None


class ForkServer:
    """Forks the processes of steps; ends with this process, and they with it.

    Args:
        environment: of all its steps.
    """

    def __init__(self, environment: dict[str, str]) -> None:
        self.environment = environment
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._process = subprocess.Popen(
                python("-m", "steps.runtime.fork_server", str(theirs.fileno())),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(),),
                env=environment,
                start_new_session=True,
            )
        self._begun: queue.SimpleQueue[tuple[int, Future[int]] | None] = queue.SimpleQueue()
        self._running: dict[int, Future[int]] = {}
        self._one_order = threading.Lock()
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    def fork(
        self, arguments: Sequence[str], environment: dict[str, str], stderr: BinaryIO, handles: Sequence[int]
    ) -> Fork | None:
        """Begin a step.

        Args:
            arguments: of `steps.main`; that it ends with the server is added.
            environment: beside that of the server.
            stderr: where the step's standard error goes.
            handles: file descriptors that the step holds open.

        Returns:
            Its process; nothing if this server has ended.
        """
        (their_input, our_input), (our_output, their_output) = os.pipe(), os.pipe()
        told = [*arguments, "--parent", str(self._process.pid)]
        order = json.dumps({"arguments": told, "environment": environment}).encode()
        given = [their_input, their_output, stderr.fileno(), *handles]
        with self._one_order:
            try:
                socket.send_fds(self._control, [order], given)
                begun = self._begun.get()
            except OSError:  # it has ended
                begun = None
        os.close(their_input)
        os.close(their_output)
        stdin, stdout = os.fdopen(our_input, "w"), os.fdopen(our_output, "r", encoding="utf-8", errors="replace")
        if begun is None:
            stdin.close()
            stdout.close()
            return None
        return Fork(*begun, stdin, stdout)

    def is_idle(self) -> bool:
        """Whether no step of it runs."""
        return not self._running

    def has_ended(self) -> bool:
        """Whether it begins no more steps."""
        return not self._listener.is_alive()

    def end(self) -> None:
        """End it, and every step of it that still runs."""
        self._process.kill()
        self._process.wait()
        self._listener.join()
        self._control.close()

    def _listen(self) -> None:
        """Take what the server answers, until it ends."""
        while answer := self._answer():
            pid = answer["pid"]
            if "status" in answer:
                self._running.pop(pid).set_result(answer["status"])
            else:
                self._running[pid] = Future()
                self._begun.put((pid, self._running[pid]))
        while self._running:
            self._running.popitem()[1].set_result(-signal.SIGKILL)  # they ended with it
        self._begun.put(None)

    def _answer(self) -> dict[str, int] | None:
        try:
            text = self._control.recv(ORDER_BYTES)
        except OSError:
            return None
        return dict(json.loads(text)) if text else None


_servers: list[ForkServer] = []
_one_look = threading.Lock()


@atexit.register
def _end_all() -> None:
    while _servers:
        _servers.pop().end()


def base_environment() -> dict[str, str]:
    """What a process of steps has of this one's environment, at this moment: Prefect is nothing to it."""
    own = {name: value for name, value in without_prefect().items() if name != SET_BY_IMPORTS}
    return {"DO_NOT_TRACK": "1", **own}


def _server() -> ForkServer:
    """The server for the environment of this moment; others end when their last step has ended."""
    now = base_environment()
    with _one_look:
        for server in tuple(_servers):
            if server.has_ended() or (server.environment != now and server.is_idle()):
                _servers.remove(server)
                server.end()
        for server in _servers:
            if server.environment == now:
                return server
        _servers.append(ForkServer(now))
        return _servers[-1]
