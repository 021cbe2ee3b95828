"""For what other processes do."""

import time
from collections.abc import Callable
from typing import TypeVar

Found = TypeVar("Found")

EVERY_S = 0.1
LONG_S = 400.0  # on a machine that is busy with other things


def wait_until(happens: Callable[[], Found]) -> Found:
    """What it gives when it is no longer false or empty; fails where that does not come."""
    deadline = time.monotonic() + LONG_S
    while not (found := happens()):
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(EVERY_S)
    return found
