"""Client of the fork server, which starts steps without their import time (`steps/runtime/fork_server.py`)."""

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

SET_BY_IMPORTS = "OpenImageIO_ROOT"  # variable that importing OpenImageIO sets
ATTEMPTS = 2  # the server may have been killed since its last step


def prepare() -> None:
    """Start the fork server, so that the first step does not wait for its imports."""
    _server()


class Fork:
    """Process of a step, with the part of the interface of `subprocess.Popen` that executors use."""

    stdin = None

    def __init__(self, server: "ForkServer", pid: int, answers: socket.socket, stdout: IO[str]) -> None:
        self.pid, self.stdout, self._answers = pid, stdout, answers
        self._server = server  # a server ends when it is garbage-collected
        weakref.finalize(self, answers.close)

    def poll(self) -> int | None:
        """Return the exit status as `Popen.poll` does."""
        try:
            return self.wait(0)
        except TimeoutError:
            return None

    def wait(self, timeout: float | None = None) -> int:
        """Return the exit status as `Popen.wait` does.

        Raises:
            TimeoutError: the process still runs after `timeout` seconds.
        """
        answer = select.poll()
        answer.register(self._answers, select.POLLIN)
        if not answer.poll(None if timeout is None else 1000 * timeout):
            raise TimeoutError
        status = self._answers.recv(ANSWER_BYTES, socket.MSG_PEEK)  # stays readable for other threads
        return int(status) if status else -signal.SIGKILL  # the server was killed, and the step with it


def fork(
    arguments: Sequence[str], environment: dict[str, str], stderr: BinaryIO, handles: Sequence[int]
) -> Fork | None:
    """Fork a step from the server of this environment; None if the server exited repeatedly."""
    for _ in range(ATTEMPTS):
        server = _server()
        if (process := server.fork(arguments, environment, stderr, handles)) is not None:
            return process
        server.end()  # waits for its end: a killed process closes its sockets before it counts as ended
    return None


class ForkServer:
    """Server process that forks steps; it and they end with this process, or when it is garbage-collected.

    Args:
        environment: environment variables of all its steps.
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
        """Fork a step.

        Args:
            arguments: arguments of `steps.main`; `--parent` is added.
            environment: variables beside those of the server.
            stderr: file for the standard error of the step.
            handles: descriptors that the step inherits.

        Returns:
            Process of the step; None if the server has ended.
        """
        arguments = [*arguments, "--parent", str(self.process.pid)]
        message = json.dumps({"arguments": arguments, "environment": environment}).encode()
        (answers, their_answers), (output, their_output) = socket.socketpair(type=socket.SOCK_SEQPACKET), os.pipe()
        stdout = os.fdopen(output, encoding="utf-8", errors="replace")
        try:
            socket.send_fds(self._control, [message], [their_answers.fileno(), their_output, stderr.fileno(), *handles])
        except OSError:  # the server has ended; the empty answer below reports it
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
    """Return the environment of steps: that of this process without Prefect's variables."""
    own = {name: value for name, value in without_prefect().items() if name != SET_BY_IMPORTS}
    return {"DO_NOT_TRACK": "1", **own}


_current: list[ForkServer] = []  # one at most
_mutex = threading.Lock()


def _server() -> ForkServer:
    """Return the server for the present environment; one for an earlier environment ends with its last step."""
    now = base_environment()
    with _mutex:
        if not _current or _current[0].environment != now or _current[0].process.poll() is not None:
            _current[:] = [ForkServer(now)]
        return _current[0]


def _end(process: subprocess.Popen[bytes], control: socket.socket) -> None:
    """Kill a server and its steps."""
    control.close()
    process.kill()
    process.wait()
