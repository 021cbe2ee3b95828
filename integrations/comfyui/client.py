"""Calls of the dg4d API in a process with an interpreter, and a torch, of its own.

The request is one JSON line on standard input, which stays open; the answer is JSON lines on standard output. A closed
standard input interrupts the call.
"""

import contextlib
import json
import os
import queue
import subprocess
import tempfile
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

WORKER = Path(__file__).with_name("worker.py")
PYTHON = "DG4D_PYTHON"
PYTHON_FILE = Path(__file__).with_name("python.txt")
CHECKOUT_PYTHON = Path(__file__).resolve().parents[2] / ".venv" / "bin" / "python"
POLL_S = 0.2  # between two checks of ComfyUI's interrupt
GRACE_S = 15.0  # for the steps to end after an interrupt
KEPT_LINES = 20  # of standard error, for messages
HIDDEN = ("PYTHONPATH", "PYTHONHOME", "PYTHONSTARTUP", "VIRTUAL_ENV")  # of ComfyUI's environment

Event = dict[str, Any]


class Dg4dError(RuntimeError):
    """Failure of a call: its message says what to do."""


def interpreter() -> Path:
    """Return the Python interpreter of dg4d's environment.

    It is named by the environment variable DG4D_PYTHON or by the first line of python.txt in this folder; without both
    it is that of the checkout that holds this folder. A workflow cannot name it.

    Raises:
        Dg4dError: there is none.
    """
    named = os.environ.get(PYTHON, "")
    source = f"${PYTHON}"
    if not named and PYTHON_FILE.is_file():
        named, source = PYTHON_FILE.read_text(encoding="utf-8").partition("\n")[0].strip(), str(PYTHON_FILE)
    if not named and CHECKOUT_PYTHON.is_file():
        return CHECKOUT_PYTHON
    if not named:
        raise Dg4dError(
            f"the Python interpreter of dg4d is not known: run `make setup` in a checkout of dg4d, then name its "
            f".venv/bin/python in ${PYTHON} or in {PYTHON_FILE}"
        )
    if not Path(named).is_file():
        raise Dg4dError(f"{source} names {named}, which does not exist; name the .venv/bin/python of a dg4d checkout")
    return Path(named)


def call(
    request: dict[str, Any], on_event: Callable[[Event], None], check: Callable[[], None], python: Path | None = None
) -> Any:
    """Run one request and return its result.

    Args:
        request: `call`, the name of a function of the worker, and `arguments`.
        on_event: called with every event but the last.
        check: called every 0.2 s; an exception of it interrupts the call and ends the process.
        python: interpreter; None: the configured one.

    Raises:
        Dg4dError: dg4d refused the request or failed, or its process ended.
    """
    command = [str(python or interpreter()), "-P", str(WORKER)]
    environment = {name: value for name, value in os.environ.items() if name not in HIDDEN}
    with tempfile.TemporaryDirectory(prefix="dg4d-comfyui-") as place:
        child = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=place, env=environment,
            text=True, encoding="utf-8", errors="replace", start_new_session=True,
        )  # fmt: skip
        try:
            return _converse(child, request, on_event, check)
        finally:
            _end(child)


def _converse(
    child: "subprocess.Popen[str]",
    request: dict[str, Any],
    on_event: Callable[[Event], None],
    check: Callable[[], None],
) -> Any:
    assert child.stdin and child.stdout and child.stderr
    lines: queue.Queue[str | None] = queue.Queue()
    said: deque[str | None] = deque(maxlen=KEPT_LINES)
    threading.Thread(target=_collect, args=(child.stdout, lines.put), daemon=True).start()
    listener = threading.Thread(target=_collect, args=(child.stderr, said.append), daemon=True)
    listener.start()
    with contextlib.suppress(BrokenPipeError):  # it ended: standard error has the reason
        child.stdin.write(json.dumps(request) + "\n")
        child.stdin.flush()
    while True:
        check()
        try:
            line = lines.get(timeout=POLL_S)
        except queue.Empty:
            continue
        if line is None:
            listener.join(1)
            raise Dg4dError(
                f"the process of dg4d ended with status {child.wait()}:\n{''.join(filter(None, said)).strip()}"
            )
        event = json.loads(line)
        if event["event"] == "result":
            return event["value"]
        if event["event"] == "error":
            raise Dg4dError(event["message"])
        on_event(event)


def _collect(stream: IO[str], put: Callable[[str | None], Any]) -> None:
    with stream:
        for line in stream:
            put(line)
    put(None)


def _end(child: "subprocess.Popen[str]") -> None:
    """Interrupt the child by closing its standard input, and kill it if it does not end."""
    assert child.stdin
    with contextlib.suppress(BrokenPipeError):  # it ended by itself
        child.stdin.close()
    try:
        child.wait(GRACE_S)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()
