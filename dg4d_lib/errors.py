"""What can go wrong that a user can mend.

DG4DError
├── BadInput              a file or a setting is wrong; the same again will fail again
├── BackendUnavailable    something needed is not here: a library, a device, weights
└── FitDiverged           a loss became non-finite, or the model emptied
"""


class DG4DError(Exception):
    """Any failure with a message for the user."""


class BadInput(DG4DError):
    """A file, a picture or a setting that cannot be used; says what was given, what is allowed and what to do."""


class BackendUnavailable(DG4DError):
    """Something needed is missing here; says what, and the command that gets it."""


class FitDiverged(DG4DError):
    """An optimization left the finite numbers, or lost its model; says the stage, the iteration and the loss."""
