"""Server that imports the libraries of all steps once and forks a process per step.

`python -m steps.runtime.fork_server SOCKET` reads orders from a socket (SOCK_SEQPACKET) that it inherits as a file
descriptor. An order is `{"arguments": [...], "environment": {...}}`: arguments of `steps.main`, and variables that the
step has beside those of this process. Descriptors come with it: standard input, output and error, and others that the
step must hold open. Answers are `{"pid": 7}`, in the order of the orders, and later `{"pid": 7, "status": 0}`: an exit
status, or the negative number of a signal. When the other end of the socket is
closed this process ends.

A step is a process group of its own, as it is when it is begun by `python -m steps.main`. Whoever asks should tell
it to end with its parent, which is this process.
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
                _tell_of_ended(control)
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
                    os.setpgid(pid, pid)  # here too, so that whoever hears its number can end the group
                for handle in handles:
                    os.close(handle)
                _tell(control, {"pid": pid})


def _have(entry: str) -> None:
    """Import a module; call a function of it, if one is named."""
    module, _, function = entry.partition(":")
    loaded = importlib.import_module(module)
    if function:
        getattr(loaded, function)()


def _become(environment: dict[str, str], handles: list[int]) -> None:
    """Make this fork the process that was ordered."""
    os.setpgid(0, 0)
    os.environ.update(environment)
    tempfile.tempdir = None  # as the environment says, not what an import found
    for number, handle in enumerate(handles[:3]):
        os.dup2(handle, number)
        os.close(handle)


def _tell_of_ended(control: socket.socket) -> None:
    with suppress(ChildProcessError):
        while (gone := os.waitpid(-1, os.WNOHANG))[0]:
            _tell(control, {"pid": gone[0], "status": os.waitstatus_to_exitcode(gone[1])})


def _tell(control: socket.socket, answer: dict[str, int]) -> None:
    with suppress(BrokenPipeError, ConnectionResetError):  # nobody listens any more: the next read says so
        control.sendall(json.dumps(answer).encode())


if __name__ == "__main__":
    sys.exit(main())
