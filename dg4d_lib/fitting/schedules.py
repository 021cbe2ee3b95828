"""Schedules of learning rates and resolutions."""

import math
from collections.abc import Sequence

from dg4d_lib.settings import Rung


def log_linear(start: float, end: float, progress: float) -> float:
    """Interpolate between `start` and `end` in equal ratios; progress in [0, 1]."""
    return math.exp(math.log(start) * (1 - progress) + math.log(end) * progress)


def size_at(ladder: Sequence[Rung], progress: float) -> int:
    """Return the resolution at a progress, in pixels: the first rung that is not passed, else the last."""
    return next((rung.size for rung in ladder if progress < rung.until), ladder[-1].size)
