"""Packages and outcomes of items that travel between machines through the store.

items/RUN.json    the outcome of an item's flow run: its package, or why there is none
results/KEY       what a step of such an item gave (flows/engine/shared_results.py)
"""

import itertools
import shutil
import tempfile
import zipfile
from pathlib import Path

from pydantic import Field, ValidationError

from flows.packages.publish import Files, load_verified, publish
from steps.contract import ArtifactRef, Frozen
from steps.store.artifact_store import ArtifactStore
from steps.store.files import room_for

FOLDER, RESULTS = "items", "results"
KEPT_S = 24 * 3600.0  # of an outcome; its package is not protected from `dg4d store gc` for longer either
PACKED = "application/vnd.dg4d.published+zip"  # a published package, with record, reports and signatures
FIRST_DATE = (1980, 1, 1, 0, 0, 0)  # of a zip entry: equal folders give equal bytes


class Outcome(Frozen):
    """Result of one item, in the words of the machine that made it.

    Attributes:
        package: the published package as a zip; None if the item failed.
        cached: whether every step had been done before.
        kind: name of the exception of a failure.
        message: of a failure, for people.
        step: that failed; empty if none did.
        pictures: that explain a failure, in the store.
        may_heal: whether the same item may do better when it is tried again.
    """

    package: ArtifactRef | None = None
    cached: bool = False
    kind: str = ""
    message: str = ""
    step: str = ""
    pictures: dict[str, ArtifactRef] = Field({})
    may_heal: bool = False


def pack(folder: Path, store: ArtifactStore) -> ArtifactRef:
    """Put a published package into the store as one artifact.

    Raises:
        DiskFull: there is no room.
        StoreUnreachable: the store does not answer.
    """
    with tempfile.TemporaryDirectory(prefix="dg4d-packed-") as scratch, room_for(Path(scratch)):
        path = Path(scratch) / "package.zip"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
            for file in sorted(file for file in folder.rglob("*") if file.is_file()):
                entry = zipfile.ZipInfo(file.relative_to(folder).as_posix(), FIRST_DATE)
                with file.open("rb") as source, archive.open(entry, "w", force_zip64=True) as target:
                    shutil.copyfileobj(source, target)
        return store.put(path, PACKED)


def deliver(package: ArtifactRef, folder: Path, store: ArtifactStore) -> Files:
    """Put a packed package into the place of what is in `folder`; return the facts of its files.

    Raises:
        ArtifactMissing: the package is gone.
        BadInput: the folder cannot be written, or the package is not whole; the folder is as it was.
    """

    def check(staging: Path, _: Files) -> Files:
        files: Files = load_verified(staging)["files"]
        return files

    return publish(store.path(package), folder, check)


def write_outcome(store: ArtifactStore, run: str, outcome: Outcome) -> None:
    """Keep the outcome of a flow run; raises as `store.write` does."""
    store.write(_name(run), outcome.model_dump_json())


def read_outcome(store: ArtifactStore, run: str) -> Outcome | None:
    """Return the outcome of a flow run; None if there is none that can be used.

    Raises:
        StoreUnreachable: the store does not answer.
    """
    try:
        outcome = Outcome.model_validate_json(store.read(_name(run)) or b"")
    except ValidationError:
        return None
    return outcome if outcome.package is None or store.has(outcome.package) else None


def forget_shared(store: ArtifactStore) -> None:
    """Remove outcomes of items and shared results of steps that are older than a day."""
    now = store.now()
    entries = itertools.chain(store.entries(FOLDER), store.entries(RESULTS))
    store.remove([entry.name for entry in entries if now - entry.modified > KEPT_S])


def _name(run: str) -> str:
    return f"{FOLDER}/{run}.json"
