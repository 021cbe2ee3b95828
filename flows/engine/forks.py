"""Processes of steps, forked from one that has imported what they need (`steps/runtime/fork_server.py`)."""

import json
import os
import select
import signal
import socket
import subprocess
import threading
import weakref
from collections.abc import Sequence
from typing import IO, BinaryIO

from flows.processes import python, without_prefect
from steps.runtime.fork_server import ANSWER_BYTES

SET_BY_IMPORTS = "OpenImageIO_ROOT"  # by a library, for its own programs
ATTEMPTS = 2  # a server may have been killed since its last step


def prepare() -> None:
    """Begin to import what steps need, so that the first step does not wait for it."""
    _server()


class Fork:
    """Process of a step, with the part of `subprocess.Popen` that executors use.

    Attributes:
        pid: of the process and of its group.
        stdin: none; it reads from /dev/null.
        stdout: what it prints.
    """

    stdin = None

    def __init__(self, server: "ForkServer", pid: int, answers: socket.socket, stdout: IO[str]) -> None:
        self.pid, self.stdout, self._answers = pid, stdout, answers
        self._server = server  # ends when nothing refers to it
        weakref.finalize(self, answers.close)

    def poll(self) -> int | None:
        """Return its exit status, or the negative number of a signal; None while it runs."""
        try:
            return self.wait(0)
        except TimeoutError:
            return None

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its exit status, or the negative number of a signal.

        Raises:
            TimeoutError: it still runs after so many seconds.
        """
        answer = select.poll()
        answer.register(self._answers, select.POLLIN)
        if not answer.poll(None if timeout is None else 1000 * timeout):
            raise TimeoutError
        said = self._answers.recv(ANSWER_BYTES, socket.MSG_PEEK)  # it stays there for other threads
        return int(said) if said else -signal.SIGKILL  # without an answer: it ended with its server


def fork(
    arguments: Sequence[str], environment: dict[str, str], stderr: BinaryIO, handles: Sequence[int]
) -> Fork | None:
    """Begin a step as `ForkServer.fork` does; None if no server stays alive for it."""
    for _ in range(ATTEMPTS):
        if (begun := _server().fork(arguments, environment, stderr, handles)) is not None:
            return begun
    return None


class ForkServer:
    """Forks the processes of steps; ends with this process, or when nothing refers to it, and they with it.

    Args:
        environment: of all its steps.
    """

    def __init__(self, environment: dict[str, str]) -> None:
        self.environment = environment
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self.process = subprocess.Popen(
                python("-m", "steps.runtime.fork_server", str(theirs.fileno())),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(),),
                env=environment,
                start_new_session=True,
            )
        self.end = weakref.finalize(self, _end, self.process, self._control)

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
            Its process; None if this server has ended.
        """
        told = [*arguments, "--parent", str(self.process.pid)]
        order = json.dumps({"arguments": told, "environment": environment}).encode()
        (answers, their_answers), (output, their_output) = socket.socketpair(type=socket.SOCK_SEQPACKET), os.pipe()
        stdout = os.fdopen(output, encoding="utf-8", errors="replace")
        try:
            socket.send_fds(self._control, [order], [their_answers.fileno(), their_output, stderr.fileno(), *handles])
        except OSError:  # it has ended
            pass
        finally:
            their_answers.close()
            os.close(their_output)
        if not (pid := answers.recv(ANSWER_BYTES)):
            answers.close()
            stdout.close()
            return None
        return Fork(self, int(pid), answers, stdout)


def base_environment() -> dict[str, str]:
    """Return what a process of steps has of this one's environment: Prefect is nothing to it."""
    own = {name: value for name, value in without_prefect().items() if name != SET_BY_IMPORTS}
    return {"DO_NOT_TRACK": "1", **own}


_current: list[ForkServer] = []  # one at most
_one_look = threading.Lock()


def _server() -> ForkServer:
    """Return the server for the environment of this moment; one for another ends with its last step."""
    now = base_environment()
    with _one_look:
        if not _current or _current[0].environment != now or _current[0].process.poll() is not None:
            _current[:] = [ForkServer(now)]
        return _current[0]


def _end(process: subprocess.Popen[bytes], control: socket.socket) -> None:
    """End a server, and every step of it that still runs."""
    control.close()
    process.kill()
    process.wait()
