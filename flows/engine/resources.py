"""Slots of this machine: its GPUs, each for one step at a time, and turns on its processor; first come, first served.

A slot is the lock of a file under `$DG4D_HOME/slots`, so that all commands of a user share them. The kernel frees it
when the last process that holds it has ended: this one, and that of the step where it has one of its own.
"""

import fcntl
import functools
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import Literal, NamedTuple

from dg4d_lib.errors import BadInput
from dg4d_lib.rasterizer.backends import CUDA, cuda_device_count
from flows.engine.turns import first_ahead, ticket
from steps.contract import StepRequest
from steps.runtime.installed_code import catalog
from steps.store.files import home

Resource = Literal["cpu", "gpu"]

POLL_S = 0.05  # between two looks at the queue and at slots that are taken
CORES_PER_STEP = 4  # a step uses every core most of the time; on many it leaves gaps
SHOWN_GPUS = "CUDA_VISIBLE_DEVICES"
stopping = threading.Event()  # set when the user stops the command: nothing more is begun


class Slot(NamedTuple):
    """What a step holds.

    Attributes:
        device: the GPU, as `$CUDA_VISIBLE_DEVICES` calls it; empty for a turn on the processor.
        handle: of the locked file; a process that inherits it holds the slot too.
    """

    device: str
    handle: int


class Turn(NamedTuple):
    """Place of a step in the queue.

    Attributes:
        begun_ns: when its item was begun, in nanoseconds since the epoch; items that were begun earlier go first.
        holder: what those who wait behind it are told.
    """

    begun_ns: int
    holder: str


class Stopped(Exception):
    """The user stopped the command while a step waited for its slot."""


def resource_of(request: StepRequest) -> Resource:
    """What a step waits for: a GPU, where it is one of those that fill one, its settings ask for it and one is here."""
    if catalog()[request.step].resource == "cpu" or not gpus():
        return "cpu"
    return "gpu" if request.weights or request.settings.get("rasterizer") == CUDA else "cpu"


@contextmanager
def slot(resource: Resource, waiting: Callable[[str], None], turn: Turn | None = None) -> Iterator[float]:
    """Hold a slot while the block runs.

    Args:
        resource: of which kind.
        waiting: told what is waited for, and behind whom, if it is not free.
        turn: place in the queue; default: behind everything that was begun before.

    Yields:
        Seconds of waiting.

    Raises:
        Stopped: the user stopped the command.
        BadInput: `$DG4D_GPUS` or `$DG4D_CPUS` is no number of slots.
    """
    folder = home() / "slots"
    folder.mkdir(parents=True, exist_ok=True)
    devices = gpus() if resource == "gpu" else tuple(map(str, range(cpus())))
    turn = turn or Turn(time.time_ns(), "another step")
    begun, told = time.monotonic(), False
    with ticket(folder / f"queue-{resource}", *turn) as own:
        while True:
            if stopping.is_set():
                raise Stopped(f"stopped while waiting for {_WORDS[resource]}")
            ahead = first_ahead(own)
            handle, device = (None, "") if ahead else _free(folder, resource, devices)
            if handle is not None:
                break
            if not told:
                told = True
                behind = ahead or _holder(folder, resource, devices)
                waiting(f"waiting for {_WORDS[resource]}" + (f", behind {behind}" if behind else ""))
            stopping.wait(POLL_S)
    os.truncate(handle, 0)
    os.write(handle, turn.holder.encode(errors="replace"))
    token = _held.set(Slot(device if resource == "gpu" else "", handle))
    try:
        yield time.monotonic() - begun
    finally:
        _held.reset(token)
        os.close(handle)


def environment() -> dict[str, str]:
    """What the process of a step must have in its environment, so that it uses what this thread holds."""
    held = _held.get()
    return {SHOWN_GPUS: held.device} if held is not None and held.device else {}


def handles() -> tuple[int, ...]:
    """What the process of a step must inherit, so that a slot is not free before it has ended."""
    held = _held.get()
    return () if held is None else (held.handle,)


def gpus() -> tuple[str, ...]:
    """The GPUs that may be used, as `$CUDA_VISIBLE_DEVICES` calls them: the first `$DG4D_GPUS` of those that are here.

    Raises:
        BadInput: `$DG4D_GPUS` is no whole number.
    """
    shown = os.environ.get(SHOWN_GPUS)
    here = _devices() if shown is None else tuple(name.strip() for name in shown.split(",") if name.strip())
    return here[: _number("DG4D_GPUS", len(here), least=0)]


def cpus() -> int:
    """How many steps may compute on the processor at a time: `$DG4D_CPUS`, else one per four cores, at least one.

    Raises:
        BadInput: `$DG4D_CPUS` is no number of steps.
    """
    return _number("DG4D_CPUS", max(1, len(os.sched_getaffinity(0)) // CORES_PER_STEP), least=1)


def slots() -> int:
    """Return how many steps may run on this machine at a time, on GPUs and processors together.

    Raises:
        BadInput: `$DG4D_GPUS` or `$DG4D_CPUS` is no number of slots.
    """
    return len(gpus()) + cpus()


_held: ContextVar[Slot | None] = ContextVar("held", default=None)
_WORDS: dict[Resource, str] = {"gpu": "a GPU", "cpu": "its turn on the processor"}


@functools.cache
def _devices() -> tuple[str, ...]:
    return tuple(map(str, range(cuda_device_count())))


def _free(folder: Path, resource: Resource, devices: tuple[str, ...]) -> tuple[int | None, str]:
    """The lock of a slot that is free, and which it is."""
    for device in devices:
        handle = os.open(_lock_file(folder, resource, device), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(handle)
        else:
            return handle, device
    return None, ""


def _lock_file(folder: Path, resource: Resource, device: str) -> Path:
    name = "".join(letter if letter.isalnum() else "-" for letter in device)
    return folder / f"{resource}-{name}.lock"


def _holder(folder: Path, resource: Resource, devices: tuple[str, ...]) -> str:
    """Return who wrote itself into the first slot; empty if nobody did."""
    with suppress(OSError, IndexError):
        return _lock_file(folder, resource, devices[0]).read_text(encoding="utf-8", errors="replace")
    return ""


def _number(variable: str, otherwise: int, least: int) -> int:
    text = os.environ.get(variable, "")
    if not text:
        return otherwise
    if not text.isdecimal() or int(text) < least:
        raise BadInput(f"${variable} is {text!r}; give a whole number from {least} on")
    return int(text)
