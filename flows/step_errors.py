"""Errors of steps that did not give a result, by what can be done about them."""

from steps.contract import ArtifactRef


class StepError(Exception):
    """A step did not give a result.

    Attributes:
        step: its name.
        message: why, for the user.
        pictures: that explain it, in the store.
    """

    def __init__(self, step: str, message: str, pictures: dict[str, ArtifactRef] | None = None) -> None:
        super().__init__(f"{step}: {message}")
        self.step, self.message, self.pictures = step, message, pictures or {}


class StepBadInput(StepError):
    """What was given cannot be used; the same again will fail again."""


class StepMissing(StepError):
    """Something needed is not here: a library, a device, weights, an artifact."""


class StepLost(StepMissing):
    """An artifact that it needs is gone or damaged; what made it will make it again."""


class StepUnreachable(StepMissing):
    """The store does not answer at the moment."""


class StepDiverged(StepError):
    """An optimization left the finite numbers; `pictures` show the last good state."""


class StepOutOfMemory(StepError):
    """There was not enough memory; there may be when other work has ended."""


class StepTimedOut(StepError):
    """It took longer than its spec allows, and was killed."""


class StepCrashed(StepError):
    """Anything else."""
