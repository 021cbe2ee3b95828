"""Server that imports the libraries of all steps once and forks a process per step.

`python -m steps.runtime.fork_server SOCKET` reads orders from a socket (SOCK_SEQPACKET) that it inherits as a file
descriptor. An order is `{"arguments": [...], "environment": {...}}`: the arguments of `steps.main`, and variables that
the step has beside those of this process. Descriptors come with it: standard input, output and error, and others that
the step must hold open. Answers are `{"pid": 7}`, in the order of the orders, and later `{"pid": 7, "status": 0}`: an
exit status, or the negative number of a signal. This process ends when the other end of the socket is closed.

A step is a process group of its own, as with `python -m steps.main`. The caller should have it end with its parent,
which is this process. A step whose code cannot be imported prints the traceback to its own standard error.
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


def main() -> int:
    """Serve until the socket is closed; in a fork, perform the step and return its exit status."""
    parser = argparse.ArgumentParser(prog="python -m steps.runtime.fork_server", description="Fork steps.")
    parser.add_argument("socket", type=int, help="file descriptor of a socket whose other end the program holds")
    control = socket.socket(fileno=parser.parse_args().socket)
    control.set_inheritable(False)
    program = _load_program()
    arguments = _serve(control, _late_imports())
    if arguments is None:
        return 0
    status = program(arguments)
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(status)  # freeing imported modules would take up to a second


def _load_program() -> Callable[[list[str]], int]:
    """Import the program that performs steps; if that fails, return one that prints the traceback.

    This process has no standard error that anybody reads, but every fork has.
    """
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
    """Yield modules, and functions to call, that steps need, in the order of the steps."""
    with suppress(Exception):  # the step will raise it again
        from steps.runtime.installed_code import catalog  # noqa: PLC0415 - errors must be caught

        for spec in catalog().values():
            yield from (spec.entry.partition(":")[0], *spec.late_imports)


def _serve(control: socket.socket, modules: Iterator[str]) -> list[str] | None:
    """Import modules between orders and fork for every order, so that first steps do not wait for later ones' imports.

    Returns:
        Arguments of the step in a fork; None in this process, when there will be no more orders.
    """
    coming = next(modules, None)
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
                with suppress(Exception):  # the step will raise it again
                    _preload(coming)
                coming = next(modules, None)
            if ended in ready:
                with suppress(BlockingIOError):
                    ended.recv(ORDER_BYTES)
                _report_ended(control)
            if control in ready:
                text, handles, _, _ = socket.recv_fds(control, ORDER_BYTES, ORDER_HANDLES)
                if not text:
                    return None
                order = json.loads(text)
                gc.freeze()  # what forks share stays shared
                pid = os.fork()
                if pid == 0:
                    signal.set_wakeup_fd(-1)
                    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                    _become(order["environment"], handles)
                    return list(order["arguments"])
                with suppress(OSError):  # it has ended
                    os.setpgid(pid, pid)  # here too: the reader of its number may kill the group at once
                for handle in handles:
                    os.close(handle)
                _answer(control, {"pid": pid})


def _preload(entry: str) -> None:
    """Import `module`, or import it and call its function for `module:function`."""
    module, _, function = entry.partition(":")
    loaded = importlib.import_module(module)
    if function:
        getattr(loaded, function)()


def _become(environment: dict[str, str], handles: list[int]) -> None:
    """Give this fork the process group, environment and descriptors of its order."""
    os.setpgid(0, 0)
    os.environ.update(environment)
    tempfile.tempdir = None  # from the new environment
    for number, handle in enumerate(handles[:3]):
        os.dup2(handle, number)
        os.close(handle)


def _report_ended(control: socket.socket) -> None:
    with suppress(ChildProcessError):
        while (gone := os.waitpid(-1, os.WNOHANG))[0]:
            _answer(control, {"pid": gone[0], "status": os.waitstatus_to_exitcode(gone[1])})


def _answer(control: socket.socket, answer: dict[str, int]) -> None:
    with suppress(BrokenPipeError, ConnectionResetError):  # the caller has ended: the next read returns nothing
        control.sendall(json.dumps(answer).encode())


if __name__ == "__main__":
    sys.exit(main())
