"""Progress, notes and pictures of a running step as JSON lines on standard output."""

import base64
import json
import logging
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from steps.runtime.job import Draw, Progress

PROGRESS_EVERY_S = 0.2
PICTURE_EVERY_S = 4.0


def progress_file(path: Path | None) -> TextIO:
    """Open the file for progress: `path`, or standard output, which then belongs to progress alone.

    Other output goes to standard error; the file descriptor is redirected because C++ libraries write to it.
    """
    if path is not None:
        return path.open("a", encoding="utf-8")
    sys.stdout.flush()
    own = os.dup(1)
    os.dup2(2, 1)
    return os.fdopen(own, "w", encoding="utf-8")


def progress_lines(file: TextIO) -> Progress:
    """Return a progress callback that writes at most five JSON lines per second, and always the last."""
    last = -PROGRESS_EVERY_S

    def report(done: int, total: int, values: dict[str, float]) -> None:
        nonlocal last
        now = time.monotonic()
        if now - last >= PROGRESS_EVERY_S or done >= total:
            last = now
            numbers = {name: float(value) for name, value in values.items()}
            _write_line(file, {"done": int(done), "total": int(total), "values": numbers})

    return report


def note_lines(file: TextIO) -> Callable[[str], None]:
    """Return a function that writes notes as JSON lines."""
    return lambda text: _write_line(file, {"note": text})


def picture_lines(file: TextIO) -> Callable[[Draw], None]:
    """Return a callback that draws a picture every few seconds and writes it as a JSON line."""
    last = time.monotonic()

    def show(draw: Draw) -> None:
        nonlocal last
        if time.monotonic() - last >= PICTURE_EVERY_S:
            _write_line(file, {"picture": base64.b64encode(draw()).decode()})
            last = time.monotonic()

    return show


@contextmanager
def notes_to(say: Callable[[str], None]) -> Iterator[None]:
    """Pass log messages of the library to `say` in the block, for example that kernels are being compiled."""
    handler = logging.Handler(logging.INFO)
    handler.emit = lambda record: say(record.getMessage())  # type: ignore[method-assign]  # saves a subclass
    logger = logging.getLogger("dg4d_lib")
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)


def _write_line(file: TextIO, message: dict[str, Any]) -> None:
    file.write(json.dumps(message) + "\n")
    file.flush()
