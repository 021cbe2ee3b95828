"""GPU and CPU slots of this machine, shared by all commands of a user, first come, first served.

A slot is a locked file in `$DG4D_SLOTS`, by default `$DG4D_HOME/slots`. The kernel frees it when the last process that
holds the file has ended: this process and the child process of the step.
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
from steps.store.files import NO_SPACE, home

Resource = Literal["cpu", "gpu"]

POLL_S = 0.05  # between two attempts to take a slot
CORES_PER_STEP = 4  # a step does not keep more cores busy all the time
SHOWN_GPUS = "CUDA_VISIBLE_DEVICES"
SLOTS_VARIABLE = "DG4D_SLOTS"
stopping = threading.Event()  # set when the user stops the command: no other step is started


class Slot(NamedTuple):
    """Slot held by a step.

    Attributes:
        device: GPU as named in `$CUDA_VISIBLE_DEVICES`; empty for a CPU slot.
        handle: descriptor of the locked file; a process that inherits it holds the slot too.
    """

    device: str
    handle: int


class Turn(NamedTuple):
    """Place of a step in the queue.

    Attributes:
        begun_ns: start of the conversion, nanoseconds since the epoch; earlier conversions go first.
        holder: name shown to steps that wait behind it.
    """

    begun_ns: int
    holder: str


class Stopped(Exception):
    """Raised to a step that waits for its slot when the user stops the command."""


def resource_of(request: StepRequest) -> Resource:
    """Return "gpu" for a step of the catalog that fills one, if its settings ask for CUDA and a GPU is available."""
    if catalog()[request.step].resource == "cpu" or not gpus():
        return "cpu"
    return "gpu" if request.weights or request.settings.get("rasterizer") == CUDA else "cpu"


@contextmanager
def slot(resource: Resource, waiting: Callable[[str], None], turn: Turn | None = None) -> Iterator[float]:
    """Hold a slot while the block runs.

    Args:
        resource: kind of slot.
        waiting: called once with a message if no slot is free.
        turn: place in the queue; default: behind all that wait.

    Yields:
        Seconds spent waiting.

    Raises:
        Stopped: the user stopped the command.
        BadInput: `$DG4D_GPUS`, `$DG4D_CPUS` or `$DG4D_SLOTS` is invalid.
    """
    folder = slot_folder()
    devices = gpus() if resource == "gpu" else tuple(map(str, range(cpus())))
    turn = turn or Turn(time.time_ns(), "another step")
    start, reported = time.monotonic(), False
    with ticket(folder / f"queue-{resource}", *turn) as own:
        while True:
            if stopping.is_set():
                raise Stopped(f"stopped while waiting for {_WORDS[resource]}")
            ahead = first_ahead(own)
            handle, device = (None, "") if ahead else _free(folder, resource, devices)
            if handle is not None:
                break
            if not reported:
                reported = True
                behind = ahead or _holder(folder, resource, devices)
                waiting(f"waiting for {_WORDS[resource]}" + (f", behind {behind}" if behind else ""))
            stopping.wait(POLL_S)
    token = _held.set(Slot(device if resource == "gpu" else "", handle))
    try:
        _name_holder(handle, turn.holder)
        yield time.monotonic() - start
    finally:
        _name_holder(handle, "")
        _held.reset(token)
        os.close(handle)


def environment() -> dict[str, str]:
    """Return the environment variables that make a child process use the GPU held by this thread."""
    held = _held.get()
    return {SHOWN_GPUS: held.device} if held is not None and held.device else {}


def handles() -> tuple[int, ...]:
    """Return the descriptors that a child process must inherit, so that the slot stays taken until it has ended."""
    held = _held.get()
    return () if held is None else (held.handle,)


def gpus() -> tuple[str, ...]:
    """Return the first `$DG4D_GPUS` visible GPUs, as named in `$CUDA_VISIBLE_DEVICES`.

    Raises:
        BadInput: `$DG4D_GPUS` is not a whole number.
    """
    shown = os.environ.get(SHOWN_GPUS)
    here = _devices() if shown is None else tuple(name.strip() for name in shown.split(",") if name.strip())
    return here[: _number("DG4D_GPUS", len(here), least=0)]


def cpus() -> int:
    """Return the number of CPU slots: `$DG4D_CPUS`, else one per four cores, at least one.

    Raises:
        BadInput: `$DG4D_CPUS` is not a whole number from 1 on.
    """
    return _number("DG4D_CPUS", max(1, len(os.sched_getaffinity(0)) // CORES_PER_STEP), least=1)


def slot_folder() -> Path:
    """Return the folder of the slots, created if missing: `$DG4D_SLOTS`, else `$DG4D_HOME/slots`.

    Raises:
        BadInput: `$DG4D_SLOTS` is a relative path, or not a folder that this user can write to.
    """
    given = os.environ.get(SLOTS_VARIABLE)
    folder = Path(given) if given else home() / "slots"
    if not folder.is_absolute():  # commands in other folders would have slots of their own
        raise BadInput(f"${SLOTS_VARIABLE} is {given!r}; set it to an absolute path, or unset it")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        if not given or error.errno in NO_SPACE:
            raise
        raise _unusable_slots(given, str(error.strerror)) from error
    if given and not os.access(folder, os.W_OK | os.X_OK):
        raise _unusable_slots(given, "no permission to write to it")
    return folder


def slots() -> int:
    """Return the number of GPU and CPU slots together.

    Raises:
        BadInput: `$DG4D_GPUS` or `$DG4D_CPUS` is invalid.
    """
    return len(gpus()) + cpus()


def _unusable_slots(given: str, reason: str) -> BadInput:
    return BadInput(f"${SLOTS_VARIABLE} is {given!r}: {reason}; set it to a folder that you can write to, or unset it")


_held: ContextVar[Slot | None] = ContextVar("held", default=None)
_WORDS: dict[Resource, str] = {"gpu": "a GPU", "cpu": "a CPU slot"}


@functools.cache
def _devices() -> tuple[str, ...]:
    return tuple(map(str, range(cuda_device_count())))


def _free(folder: Path, resource: Resource, devices: tuple[str, ...]) -> tuple[int | None, str]:
    """Lock a free slot; return its descriptor and device, or None if all are taken."""
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


def _name_holder(handle: int, holder: str) -> None:
    """Write the name of a slot's holder into its file, for waiting steps; on a full disk it stays unknown."""
    with suppress(OSError):
        os.truncate(handle, 0)
        os.pwrite(handle, holder.encode(errors="replace"), 0)


def _holder(folder: Path, resource: Resource, devices: tuple[str, ...]) -> str:
    """Return the name that the holder of the first slot wrote into its file; empty if there is none."""
    with suppress(OSError, IndexError):
        return _lock_file(folder, resource, devices[0]).read_text(encoding="utf-8", errors="replace")
    return ""


def _number(variable: str, otherwise: int, least: int) -> int:
    text = os.environ.get(variable, "")
    if not text:
        return otherwise
    if not text.isdecimal() or int(text) < least:
        raise BadInput(f"${variable} is {text!r}; set it to a whole number from {least} on, or unset it")
    return int(text)
