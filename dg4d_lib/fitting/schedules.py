"""Schedules of learning rates and resolutions."""

import math
from collections.abc import Sequence

from dg4d_lib.settings import ResolutionStage


def log_linear(start: float, end: float, progress: float) -> float:
    """Interpolate log-linearly between `start` and `end`; progress in [0, 1]."""
    return math.exp(math.log(start) * (1 - progress) + math.log(end) * progress)


def resolution_at(schedule: Sequence[ResolutionStage], progress: float) -> int:
    """Return the render size in pixels: that of the first stage with `until` above progress, else of the last."""
    return next((stage.size for stage in schedule if progress < stage.until), schedule[-1].size)
