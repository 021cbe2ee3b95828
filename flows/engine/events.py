"""What happens while steps run, told to whoever listens in this process: the terminal, for one."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class StepEvent:
    """One thing that happened to one step of one item.

    Attributes:
        item: name of the asset.
        step: name of the step, with the part of the work it does where it was divided.
        kind: what happened; `finished` has `cached` and `seconds`, `progress` has `done`, `total` and `values`,
            `note` has `text`, and so has `remark`, which stays on the screen.
        cached: whether the result was there already.
        waited_s: seconds of `seconds` in which the step waited for its turn.
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


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Tell `listener` every event while the block runs; it is called from the threads that run steps."""
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)


def emit(event: StepEvent) -> None:
    """Call every listener with an event."""
    for listener in tuple(_listeners):
        listener(event)
