"""Transport of packages and outcomes of items between machines through the store.

items/RUN.json    outcome of an item's flow run: its package, or its failure
results/KEY       result of a step of such an item (flows/engine/shared_results.py)
"""

import itertools
from pathlib import Path

from pydantic import Field, ValidationError

from flows.inputs.sources import put_zip
from flows.packages.publish import Files, Say, load_verified, publish
from steps.contract import ArtifactRef, Frozen
from steps.store.artifact_store import ArtifactStore

FOLDER, RESULTS = "items", "results"
KEPT_S = 24 * 3600.0  # lifetime of an outcome; its package is protected from `dg4d store gc` for as long
PACKED = "application/vnd.dg4d.published+zip"  # a published package, with record, reports and signatures


class Outcome(Frozen):
    """Result of one item on the machine that made it.

    Attributes:
        package: published package as a zip; None if the item failed.
        cached: True if every step had been done before.
        kind: name of the exception of a failure.
        message: of a failure, for people.
        step: that failed; empty if none did.
        pictures: that explain a failure, in the store.
        may_heal: True if another attempt may succeed.
    """

    package: ArtifactRef | None = None
    cached: bool = False
    kind: str = ""
    message: str = ""
    step: str = ""
    pictures: dict[str, ArtifactRef] = Field({})
    may_heal: bool = False


def pack_package(folder: Path, store: ArtifactStore) -> ArtifactRef:
    """Put a published package into the store as one artifact.

    Raises:
        DiskFull: the disk is full.
        StoreUnreachable: the store does not answer.
    """
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    return put_zip({file.relative_to(folder).as_posix(): file for file in files}, PACKED, store)


def unpack_package(package: ArtifactRef, folder: Path, store: ArtifactStore, say: Say = lambda _: None) -> Files:
    """Replace the package in `folder` by a packed one; return the digests of its files; see `publish`.

    Raises:
        ArtifactMissing: the package is gone.
        BadInput: the folder cannot be written, or the package is damaged; the folder is as it was.
    """

    def check(staging: Path, _: Files) -> Files:
        files: Files = load_verified(staging)["files"]
        return files

    return publish(store.path(package), folder, check, say)


def write_outcome(store: ArtifactStore, run: str, outcome: Outcome) -> None:
    """Keep the outcome of a flow run; raises as `store.write` does."""
    store.write(f"{FOLDER}/{run}.json", outcome.model_dump_json())


def read_outcome(store: ArtifactStore, run: str) -> Outcome | None:
    """Return the outcome of a flow run; None if there is none, or its package is gone.

    Raises:
        StoreUnreachable: the store does not answer.
    """
    try:
        outcome = Outcome.model_validate_json(store.read(f"{FOLDER}/{run}.json") or b"")
    except ValidationError:
        return None
    return outcome if outcome.package is None or store.has(outcome.package) else None


def remove_expired(store: ArtifactStore) -> None:
    """Remove outcomes of items and shared results of steps that are older than a day."""
    now = store.now()
    entries = itertools.chain(store.entries(FOLDER), store.entries(RESULTS))
    store.remove([entry.name for entry in entries if now - entry.modified > KEPT_S])
