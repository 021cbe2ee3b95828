"""Garbage collection of a store (`dg4d store gc`)."""

from collections import Counter
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from flows.engine import leases
from flows.engine.records import read_record
from flows.engine.versions import Version, versions
from steps.store.artifact_store import ArtifactStore, Entry

GRACE_S = 24 * 3600.0  # younger artifacts, counted from the start of the oldest run, may belong to a running step
BATCH = 500  # artifacts removed between two refreshes of the lock


@dataclass(frozen=True)
class Collected:
    """Versions and artifacts that a collection removed, or would remove."""

    versions: list[Version]
    artifacts: list[Entry]


def collect(
    store: ArtifactStore, records: Path, keep: int | None = None, dry_run: bool = False, grace_s: float = GRACE_S
) -> Collected:
    """Remove old versions, and artifacts that neither a version nor a run needs.

    Records of versions are removed before their artifacts and cached results of steps last, so that an interruption
    leaves no version with missing artifacts.

    Args:
        store: store to collect.
        records: folder of the cached results of steps on this machine.
        keep: number of versions kept per item, the newest; None: all.
        dry_run: remove nothing.
        grace_s: minimum age of removed artifacts, in seconds before now and before the start of the oldest run.

    Raises:
        BadInput: another process collects this store.
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
    """Return the newest `keep` versions of each item, and the others."""
    kept: list[Version] = []
    old: list[Version] = []
    count: Counter[str] = Counter()
    for version in known:  # the newest of an item first
        count[version.item] += 1
        (kept if keep is None or count[version.item] <= keep else old).append(version)
    return kept, old


def _forget_results(records: Path, here: set[str], before: float) -> None:
    """Remove cached results that are older than `before` and unreadable, or that refer to missing artifacts."""
    if not records.is_dir():
        return
    for path in records.iterdir():
        if path.is_file() and path.stat().st_mtime < before and not _outputs(path) <= here:
            path.unlink(missing_ok=True)


def _outputs(record: Path) -> set[str]:
    """Return the digests that a result refers to; one that no store has if the record is unreadable."""
    result = read_record(record)
    return {"unreadable"} if result is None else {ref.digest for ref in result.outputs.values()}
