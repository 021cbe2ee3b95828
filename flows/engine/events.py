"""Events of running steps for listeners in this process, such as the terminal."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class StepEvent:
    """Event of one step of one item.

    Attributes:
        item: name of the asset.
        step: label of the step, with its part if its frames are divided.
        kind: `finished` sets `cached`, `seconds` and `waited_s`; `progress` sets `done`, `total` and `values`; `note`
            sets `text`, and so does `remark`, which stays on the screen.
        cached: true if the result existed before.
        waited_s: share of `seconds` spent waiting for a slot.
    """

    item: str
    step: str
    kind: Literal["started", "progress", "note", "remark", "finished", "failed"]
    done: int = 0
    total: int = 0
    values: dict[str, float] = field(default_factory=dict)
    seconds: float = 0.0
    waited_s: float = 0.0
    cached: bool = False
    text: str = ""


Listener = Callable[[StepEvent], None]
_listeners: list[Listener] = []
_of_context: ContextVar[tuple[Listener, ...]] = ContextVar("of_context", default=())


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Call `listener` with every event while the block runs, from the threads that run steps."""
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


@contextmanager
def listening_in_context(listener: Listener) -> Iterator[None]:
    """Call `listener` with the events of conversions that begin in this context while the block runs.

    Threads that run steps get a copy of the context of their conversion.
    """
    token = _of_context.set((*_of_context.get(), listener))
    try:
        yield
    finally:
        _of_context.reset(token)


def emit(event: StepEvent) -> None:
    """Call the listeners of this process and of this context with an event."""
    for listener in (*_listeners, *_of_context.get()):
        listener(event)


def remark_on_output(item: str) -> Callable[[str], None]:
    """Return a function that emits a sentence about the output folder of an item."""
    return lambda text: emit(StepEvent(item, "output", "remark", text=text))
