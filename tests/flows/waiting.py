"""Commands in processes of their own, and what is waited for."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from typing import TypeVar

import pytest
from prefect import Task

from flows import tasks
from flows.engine.step_tasks import RETRIES

Found = TypeVar("Found")

EVERY_S = 0.1
LONG_S = 400.0  # on a machine that is busy with other things


def start(*arguments: str) -> "subprocess.Popen[str]":
    """The command in a process of its own, with steps in theirs."""
    return subprocess.Popen(
        [sys.executable, "-m", "flows.cli", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "DG4D_EXECUTOR": "subprocess"},
    )


def retry_after(seconds: float, patch: pytest.MonkeyPatch) -> None:
    """Retry the tasks of steps after so many seconds."""
    for task in vars(tasks).values():
        if isinstance(task, Task):
            patch.setattr(task, "retry_delay_seconds", [seconds] * RETRIES)


def wait_until(happens: Callable[[], Found]) -> Found:
    """What it gives when it is no longer false or empty; fails where that does not come."""
    deadline = time.monotonic() + LONG_S
    while not (found := happens()):
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(EVERY_S)
    return found
