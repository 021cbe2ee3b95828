"""Server that imports the libraries of all steps once and forks a process per step.

`python -m steps.runtime.fork_server SOCKET` reads orders from an inherited socket (SOCK_SEQPACKET), given as a file
descriptor. An order is `{"arguments": [...], "environment": {...}}`: arguments of `steps.main`, and additional
environment variables. Descriptors come with it: a socket for answers (SOCK_SEQPACKET), standard output and error, and
others that the step must hold open. The answers are the process id, and later the exit status or the negative number
of a signal. The server exits when the other end of the first socket is closed.

A step is a process group of its own, as with `python -m steps.main`. The client should make it exit with its parent,
which is this process.

The standard library's forkserver imports the program's main module in every child, which is Prefect's engine in a
worker (2.5 s), and its children outlive a client that is killed. A step whose code cannot be imported prints the
traceback to its own standard error.
"""

import argparse
import functools
import gc
import importlib
import json
import os
import selectors
import signal
import socket
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator
from contextlib import suppress

ORDER_BYTES = 2**16
ORDER_HANDLES = 16
ANSWER_BYTES = 32


def main() -> int:
    """Serve until the socket is closed; in a fork, perform the step and return its exit status."""
    parser = argparse.ArgumentParser(prog="python -m steps.runtime.fork_server", description="Fork steps.")
    parser.add_argument("socket", type=int, help="file descriptor of a socket whose other end the client holds")
    control = socket.socket(fileno=parser.parse_args().socket)
    control.set_inheritable(False)
    gc.disable()  # a quarter of the time of imports; each step enables it
    program = _load_program()
    arguments = _serve(control, _late_imports())
    if arguments is None:
        return 0
    status = program(arguments)
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(status)  # a regular exit frees imported modules for up to a second


def _load_program() -> Callable[[list[str]], int]:
    """Import the program that performs steps; if that fails, return one that prints the traceback in every fork."""
    try:
        from steps.runtime import process_setup, program  # noqa: PLC0415 - errors must be caught

        process_setup.prepare_process()
    except Exception:
        return functools.partial(_fail, traceback.format_exc())
    return program.main


def _fail(reason: str, arguments: list[str]) -> int:
    sys.stderr.write(reason)
    return 1


def _late_imports() -> Iterator[str]:
    """Yield the modules and functions that steps import, in the order of the steps."""
    with suppress(Exception):  # the step raises it again
        from steps.runtime.installed_code import catalog  # noqa: PLC0415 - errors must be caught

        for spec in catalog().values():
            yield from (spec.entry.partition(":")[0], *spec.late_imports)


def _serve(control: socket.socket, modules: Iterator[str]) -> list[str] | None:
    """Fork for every order, and import modules between orders, so that first steps do not wait for later ones' imports.

    Returns:
        In a fork, the arguments of its step; in the server, None when the client is gone.
    """
    upcoming = next(modules, None)
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
            ready = [key.fileobj for key, _ in events.select(0 if upcoming else None)]
            if upcoming and not ready:
                with suppress(Exception):  # the step raises it again
                    _preload(upcoming)
                upcoming = next(modules, None)
            if ended in ready:
                with suppress(BlockingIOError):
                    ended.recv(ORDER_BYTES)
                _answer_for_ended(running)
            if control in ready:
                order, (*handles,), _, _ = socket.recv_fds(control, ORDER_BYTES, ORDER_HANDLES)
                if not order:
                    return None
                gc.freeze()  # the collector would write to memory that forks share
                pid = os.fork()
                if pid == 0:
                    signal.set_wakeup_fd(-1)
                    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                    return _become(handles, **json.loads(order))
                with suppress(OSError):  # it has exited
                    os.setpgid(pid, pid)  # also here: the group must exist before the client learns the process id
                running[pid] = socket.socket(fileno=handles[0])
                for handle in handles[1:]:
                    os.close(handle)
                _answer(running[pid], pid)


def _preload(entry: str) -> None:
    """Import `module`, or import it and call its function for `module:function`."""
    module, _, function = entry.partition(":")
    loaded = importlib.import_module(module)
    if function:
        getattr(loaded, function)()


def _become(handles: list[int], arguments: list[str], environment: dict[str, str]) -> list[str]:
    """Make this fork the process that was ordered; return its arguments."""
    gc.enable()
    os.setpgid(0, 0)
    os.environ.update(environment)
    tempfile.tempdir = None  # forget the folder that an import found; $TMPDIR may differ
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
    with suppress(BrokenPipeError, ConnectionResetError):  # the client has closed its end
        answers.sendall(str(number).encode())


if __name__ == "__main__":
    sys.exit(main())
