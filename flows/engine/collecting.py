"""Removing from a store what no version and no run needs; behind `dg4d store gc`."""

from collections import Counter
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from flows.engine import leases
from flows.engine.records import read_record
from flows.engine.versions import Version, versions
from steps.store.artifact_store import ArtifactStore, Entry

GRACE_S = 24 * 3600.0  # what is younger, or was young when the oldest run began, may be needed by somebody
BATCH = 500  # artifacts that are removed before a sign of life


@dataclass(frozen=True)
class Collected:
    """What was removed, or would be.

    Attributes:
        versions: those beyond the newest few of their item.
        artifacts: those that nothing needs.
    """

    versions: list[Version]
    artifacts: list[Entry]


def collect(
    store: ArtifactStore, records: Path, keep: int | None = None, dry_run: bool = False, grace_s: float = GRACE_S
) -> Collected:
    """Remove what no version and no run needs.

    Records of versions go before their artifacts, so that a stop at any moment leaves whole versions and some that are
    not there; results of steps whose artifacts are gone go last.

    Args:
        store: where to remove.
        records: the folder of this machine that says what each request gave.
        keep: so many of the newest versions of each item stay; all without it.
        dry_run: remove nothing.
        grace_s: what was written less than this long ago stays; so does what was written less than this long before
            the oldest run began.

    Raises:
        BadInput: somebody else is at it.
        StoreUnreachable: the store does not answer.
    """
    with leases.collecting(store) as alive:
        now = store.now()
        needed, since = leases.needed(store, now)
        kept, old = _divided(versions(store), keep)
        needed = needed.union(*(version.artifacts() for version in kept))
        here = list(store.artifacts())
        useless = [entry for entry in here if entry.name not in needed and entry.modified < since - grace_s]
        if not dry_run:
            store.remove([version.name for version in old])
            rest = iter(useless)
            while batch := [entry.name for entry in islice(rest, BATCH)]:
                store.drop(batch)
                alive()
            store.tidy(grace_s)
            _forget_results(records, {entry.name for entry in here} - {entry.name for entry in useless}, now - grace_s)
    return Collected(old, sorted(useless))


def _divided(known: list[Version], keep: int | None) -> tuple[list[Version], list[Version]]:
    """The newest few versions of each item, and the others."""
    kept: list[Version] = []
    old: list[Version] = []
    count: Counter[str] = Counter()
    for version in known:  # the newest of an item first
        count[version.item] += 1
        (kept if keep is None or count[version.item] <= keep else old).append(version)
    return kept, old


def _forget_results(records: Path, here: set[str], before: float) -> None:
    """Remove old results of steps that refer to artifacts which are gone, or that cannot be read."""
    if not records.is_dir():
        return
    for path in records.iterdir():
        if path.is_file() and path.stat().st_mtime < before and not _outputs(path) <= here:
            path.unlink(missing_ok=True)


def _outputs(record: Path) -> set[str]:
    """Return the artifacts that a result refers to; an artifact that no store has where the record is unreadable."""
    result = read_record(record)
    return {"unreadable"} if result is None else {ref.digest for ref in result.outputs.values()}
