"""Exit codes of commands."""

from collections.abc import Iterable

EXIT_FAILED = 1
EXIT_BAD_INPUT = 65
EXIT_MISSING = 69
EXIT_HANGUP, EXIT_INTERRUPTED, EXIT_PIPE, EXIT_TERMINATED = 129, 130, 141, 143  # 128 + signal number, as in shells

EXIT_STATUS = dict.fromkeys(  # by the class name of an exception; of all others EXIT_FAILED
    ("BadInput", "DiskFull", "TooLarge", "FitDiverged", "Diverged", "StepBadInput", "StepDiverged"), EXIT_BAD_INPUT
) | dict.fromkeys(
    (
        "BackendUnavailable", "StoreUnreachable", "ArtifactMissing", "ServerUnavailable",
        "StepMissing", "StepLost", "StepUnreachable",
    ),
    EXIT_MISSING,
)  # fmt: skip


def exit_status_of(kinds: Iterable[str]) -> int:
    """Return the exit status of a command for several items of which at least one failed.

    Args:
        kinds: class name of the exception of every item; empty if the item did not fail.

    Returns:
        The exit status that each of the failures has alone if every item failed and they agree; else EXIT_FAILED.
    """
    found = {EXIT_STATUS.get(kind, EXIT_FAILED) for kind in kinds}
    return found.pop() if len(found) == 1 else EXIT_FAILED
