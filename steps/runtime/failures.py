"""Exceptions of a step as failures of the contract: kind and message."""

import traceback
from pathlib import Path

from dg4d_lib.errors import BackendUnavailable, BadInput, FitDiverged
from steps.contract import FailureKind
from steps.store.artifact_store import ArtifactMissing, StoreUnreachable
from steps.store.files import NO_SPACE


def failure_kind(error: BaseException) -> FailureKind:
    """Return the contract's kind of failure for an exception."""
    kind: FailureKind = "crashed"
    match error:
        case BadInput():
            kind = "bad_input"
        case OSError() if error.errno in NO_SPACE:
            kind = "bad_input"
        case StoreUnreachable():
            kind = "unreachable"
        case ArtifactMissing():
            kind = "lost"
        case BackendUnavailable():
            kind = "missing"
        case FitDiverged():
            kind = "diverged"
        case MemoryError():
            kind = "out_of_memory"
        case RuntimeError() if type(error).__name__ == "OutOfMemoryError" or "can't allocate memory" in str(error):
            kind = "out_of_memory"  # torch: CUDA, CPU
    return kind


def failure_message(error: BaseException) -> str:
    """Return the message of a failure for the user."""
    if isinstance(error, OSError) and error.errno in NO_SPACE:
        return "the disk is full: free some space and run the same command again; finished steps are kept"
    if failure_kind(error) == "out_of_memory":
        said = f" ({error})" if str(error) else ""
        return f"memory ran out: end other programs, or choose smaller settings{said}"
    if failure_kind(error) == "crashed":
        where = traceback.extract_tb(error.__traceback__)
        place = f" (at {Path(where[-1].filename).name}:{where[-1].lineno})" if where else ""
        return f"{type(error).__name__}: {error}{place}"
    return str(error) or type(error).__name__
