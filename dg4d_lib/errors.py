"""Exceptions for errors that a user can fix.

DG4DError
├── BadInput              invalid file or setting; a retry fails again
├── BackendUnavailable    missing library, device or weights
└── FitDiverged           non-finite loss, or a model without Gaussians
"""

from collections.abc import Sequence

MAX_QUOTED = 80  # characters of a value in a message
OUT_OF_MEMORY = (  # in messages of errors that are not torch.OutOfMemoryError
    "can't allocate memory",  # the allocator of the CPU
    "CUDA error: out of memory",  # the CUDA runtime, outside of torch's allocator
    "CUBLAS_STATUS_ALLOC_FAILED",  # cuBLAS allocates its own workspace
    "CUDNN_STATUS_ALLOC_FAILED",
)


class DG4DError(Exception):
    """Base class of errors with a message for the user."""


class BadInput(DG4DError):
    """Invalid file or setting; the message names what was given, what is allowed and what to do."""


class BackendUnavailable(DG4DError):
    """Missing dependency; the message names it and the command that installs it."""


class FitDiverged(DG4DError):
    """Diverged optimization; the message names the stage, the iteration and the value."""


def quoted(value: object) -> str:
    """Return the `repr` of a value for a message, shortened to `MAX_QUOTED` characters."""
    text = repr(value)
    return text if len(text) <= MAX_QUOTED else f"{text[:MAX_QUOTED]}..."


def listed(items: Sequence[str], most: int) -> str:
    """Return the first items of a list for a message, and how many more there are."""
    more = f" and {len(items) - most} more" if len(items) > most else ""
    return ", ".join(items[:most]) + more


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether torch ran out of memory, on a GPU or on the CPU; torch itself is not imported for this."""
    if not isinstance(error, RuntimeError):
        return False
    return type(error).__name__ == "OutOfMemoryError" or any(sign in str(error) for sign in OUT_OF_MEMORY)
