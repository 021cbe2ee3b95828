"""Kind and message of a step's failure, from its exception."""

import traceback
from pathlib import Path

from dg4d_lib.errors import BackendUnavailable, BadInput, FitDiverged, is_out_of_memory
from steps.contract import FailureKind
from steps.store.artifact_store import ArtifactMissing, StoreUnreachable
from steps.store.files import NO_SPACE

KINDS: dict[type[BaseException], FailureKind] = {  # the first match counts: StoreUnreachable is a BackendUnavailable
    BadInput: "bad_input",
    StoreUnreachable: "unreachable",
    ArtifactMissing: "lost",
    BackendUnavailable: "missing",
    FitDiverged: "diverged",
    MemoryError: "out_of_memory",
}

MEMORY_SETTINGS = "subject.size, static.views, motion.views or mesh.grid"


def failure_kind(error: BaseException) -> FailureKind:
    """Return the contract's kind of failure for an exception."""
    if isinstance(error, OSError) and error.errno in NO_SPACE:
        return "bad_input"
    if is_out_of_memory(error):
        return "out_of_memory"
    return next((kind for matched, kind in KINDS.items() if isinstance(error, matched)), "crashed")


def failure_message(error: BaseException) -> str:
    """Return the message of a failure for the user."""
    if isinstance(error, OSError) and error.errno in NO_SPACE:
        return "the disk is full: free some space and run the same command again; finished steps are kept"
    if failure_kind(error) == "out_of_memory":
        reason = f" ({error})" if str(error) else ""
        return f"memory ran out: end other programs, or lower {MEMORY_SETTINGS}{reason}"
    if failure_kind(error) == "crashed":
        frames = traceback.extract_tb(error.__traceback__)
        line = f" (at {Path(frames[-1].filename).name}:{frames[-1].lineno})" if frames else ""
        return f"{type(error).__name__}: {error}{line}"
    return str(error) or type(error).__name__
