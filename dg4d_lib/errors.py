"""Exceptions for errors that a user can fix.

DG4DError
├── BadInput              invalid file or setting; a retry fails again
├── BackendUnavailable    missing library, device or weights
└── FitDiverged           non-finite loss, or a model without Gaussians
"""


class DG4DError(Exception):
    """Base class of errors with a message for the user."""


class BadInput(DG4DError):
    """Invalid file or setting; the message names what was given, what is allowed and what to do."""


class BackendUnavailable(DG4DError):
    """Missing dependency; the message names it and the command that installs it."""


class FitDiverged(DG4DError):
    """Diverged optimization; the message names the stage, the iteration and the value."""
