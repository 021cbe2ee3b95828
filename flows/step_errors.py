"""Exceptions of failed steps."""

from typing import Any

from dg4d_lib.errors import BackendUnavailable, BadInput, DG4DError
from steps.contract import ArtifactRef


class StepError(DG4DError):
    """Failure of a step.

    Attributes:
        step: name of the step.
        message: reason, for the user.
        pictures: pictures in the store that explain it.
    """

    def __init__(self, step: str, message: str, pictures: dict[str, ArtifactRef] | None = None) -> None:
        super().__init__(f"{step}: {message}")
        self.step, self.message, self.pictures = step, message, pictures or {}

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the arguments of `__init__`; `args` holds one string."""
        return type(self), (self.step, self.message, self.pictures)


class StepBadInput(StepError, BadInput):
    """Unusable input; a retry fails again."""


class StepMissing(StepError, BackendUnavailable):
    """Missing library, device, weights or artifact."""


class StepLost(StepMissing):
    """Missing or damaged input artifact; running the conversion again restores it."""


class StepUnreachable(StepMissing):
    """Store that does not answer."""


class StepDiverged(StepError):
    """Optimization with non-finite values; `pictures` show the last finite state."""


class StepOutOfMemory(StepError):
    """Out of memory; a retry may succeed when other work has ended."""


class StepTimedOut(StepError):
    """Step killed after `timeout_s` of its spec."""


class StepCrashed(StepError):
    """Any other failure."""
