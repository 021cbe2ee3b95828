"""Server that imports the libraries of all steps once and forks a process per step.

`python -m steps.runtime.fork_server SOCKET` reads orders from a socket (SOCK_SEQPACKET) that it inherits as a file
descriptor. An order is `{"arguments": [...], "environment": {...}}`: arguments of `steps.main`, and variables that the
step has beside those of this process. Descriptors come with it: a socket for answers (SOCK_SEQPACKET), standard output
and error, and others that the step must hold open. The answers are the number of the process, and later its exit
status, or the negative number of a signal. When the other end of the first socket is closed this process ends.

A step is a process group of its own, as it is when it is begun by `python -m steps.main`. The client should have it end
with its parent, which is this process.

The standard library's forkserver imports the program's main module in every child, which is Prefect's engine in a
worker (2.5 s), and its children outlive a client that is killed.
"""

import argparse
import gc
import importlib
import json
import os
import selectors
import signal
import socket
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress

from steps import main as step

ORDER_BYTES = 2**16
ORDER_HANDLES = 16
ANSWER_BYTES = 32


def main() -> int:
    """Serve until the socket is closed; in a fork, do the step, and return its exit status."""
    parser = argparse.ArgumentParser(prog="python -m steps.runtime.fork_server", description="Begin steps.")
    parser.add_argument("socket", type=int, help="file descriptor of a socket that the program holds the other end of")
    control = socket.socket(fileno=parser.parse_args().socket)
    control.set_inheritable(False)
    step.prepare_process()
    arguments = _serve(control, _wanted())
    if arguments is None:
        return 0
    status = step.main(arguments)
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(status)  # nothing is left to tidy, and to take apart what was imported takes up to a second


def _wanted() -> Iterator[str]:
    """What steps would wait for, in the order in which they come to it: modules, and functions to call."""
    for spec in step.catalog().values():
        yield spec.entry.partition(":")[0]
        yield from spec.late_imports


def _serve(control: socket.socket, wanted: Iterator[str]) -> list[str] | None:
    """Import what is wanted, and fork for every order; the first steps need not wait for what only later ones import.

    Returns:
        Arguments of a step in a fork; nothing here, when there will be no more orders.
    """
    coming = next(wanted, None)
    running: dict[int, socket.socket] = {}
    ended, signaled = socket.socketpair()
    for end in (ended, signaled):
        end.setblocking(False)
    signal.signal(signal.SIGCHLD, lambda number, frame: None)
    signal.set_wakeup_fd(signaled.fileno(), warn_on_full_buffer=False)
    with selectors.DefaultSelector() as events, control, ended, signaled:
        events.register(control, selectors.EVENT_READ)
        events.register(ended, selectors.EVENT_READ)
        while True:
            ready = [key.fileobj for key, _ in events.select(0 if coming else None)]
            if coming and not ready:
                with suppress(Exception):  # the step will say what is wrong
                    _have(coming)
                coming = next(wanted, None)
            if ended in ready:
                with suppress(BlockingIOError):
                    ended.recv(ORDER_BYTES)
                _answer_for_ended(running)
            if control in ready:
                order, (*handles,), _, _ = socket.recv_fds(control, ORDER_BYTES, ORDER_HANDLES)
                if not order:
                    return None
                gc.freeze()  # what forks share stays shared
                pid = os.fork()
                if pid == 0:
                    signal.set_wakeup_fd(-1)
                    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                    return _become(handles, **json.loads(order))
                with suppress(OSError):  # it has ended
                    os.setpgid(pid, pid)  # here too, so that whoever hears its number can end the group
                running[pid] = socket.socket(fileno=handles[0])
                for handle in handles[1:]:
                    os.close(handle)
                _answer(running[pid], pid)


def _have(entry: str) -> None:
    """Import a module; call a function of it, if one is named."""
    module, _, function = entry.partition(":")
    loaded = importlib.import_module(module)
    if function:
        getattr(loaded, function)()


def _become(handles: list[int], arguments: list[str], environment: dict[str, str]) -> list[str]:
    """Make this fork the process that was ordered; return its arguments."""
    os.setpgid(0, 0)
    os.environ.update(environment)
    tempfile.tempdir = None  # as the environment says, not what an import found
    os.close(handles[0])
    for number, handle in enumerate(handles[1:3], 1):
        os.dup2(handle, number)
        os.close(handle)
    return arguments


def _answer_for_ended(running: dict[int, socket.socket]) -> None:
    with suppress(ChildProcessError):
        while (gone := os.waitpid(-1, os.WNOHANG))[0]:
            if (answers := running.pop(gone[0], None)) is not None:
                _answer(answers, os.waitstatus_to_exitcode(gone[1]))
                answers.close()


def _answer(answers: socket.socket, number: int) -> None:
    with suppress(BrokenPipeError, ConnectionResetError):  # the client has lost interest, or has ended
        answers.sendall(str(number).encode())


if __name__ == "__main__":
    sys.exit(main())
