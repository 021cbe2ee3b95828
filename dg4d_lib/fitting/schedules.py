"""Schedules of learning rates and resolutions."""

import math
from collections.abc import Sequence

from dg4d_lib.settings import FitSettings, ResolutionStage


def log_linear(start: float, end: float, progress: float) -> float:
    """Interpolate log-linearly between `start` and `end`; progress in [0, 1]."""
    return math.exp(math.log(start) * (1 - progress) + math.log(end) * progress)


def late_decay(end: float, progress: float) -> float:
    """Return a factor on learning rates: 1 up to half of the progress, then log-linear to `end`."""
    return log_linear(1, end, max(0, 2 * progress - 1))


def resolution_at(schedule: Sequence[ResolutionStage], progress: float) -> int:
    """Return the render size in pixels: that of the first stage with `until` above progress, else of the last."""
    return next((stage.size for stage in schedule if progress < stage.until), schedule[-1].size)


def reference_size_at(settings: FitSettings, progress: float) -> int:
    """Return the pixels of the reference view: those of its schedule, but at most its full size."""
    full = settings.reference_size
    return min(full, next((stage.size for stage in settings.reference_schedule if progress < stage.until), full))
