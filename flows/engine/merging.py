"""Artifacts that hold a file per frame: counting the frames, and joining what was made in parts."""

import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path

from steps.contract import ArtifactRef
from steps.store import ArtifactStore, room_for

EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest time a zip can hold: equal entries give equal bytes


def frames_in(frames: ArtifactRef, store: ArtifactStore) -> int:
    """How many frames a `frames` artifact has."""
    with zipfile.ZipFile(store.path(frames)) as archive:
        return sum(name.endswith(".png") for name in archive.namelist())


def merged(parts: Sequence[ArtifactRef], store: ArtifactStore) -> ArtifactRef:
    """One stored zip with the entries of all parts, in the order of their names; the order of parts does not matter.

    Raises:
        ValueError: two parts have an entry of one name.
    """
    entries: dict[str, tuple[zipfile.ZipFile, zipfile.ZipInfo]] = {}
    archives = [zipfile.ZipFile(store.path(part)) for part in parts]
    try:
        for archive in archives:
            for entry in archive.infolist():
                if entry.filename in entries and not _equal(entries[entry.filename], (archive, entry)):
                    raise ValueError(f"two parts have different entries {entry.filename}")
                entries[entry.filename] = archive, entry
        with tempfile.TemporaryDirectory(prefix="dg4d-merge-") as folder, room_for(Path(folder)):
            path = Path(folder) / "merged.zip"
            with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as whole:
                for name in sorted(entries):
                    source, entry = entries[name]
                    add(whole, name, source.read(entry))
            return store.put(path, parts[0].media_type)
    finally:
        for archive in archives:
            archive.close()


def add(archive: zipfile.ZipFile, name: str, content: bytes) -> None:
    """Add an entry without anything that depends on time or machine."""
    info = zipfile.ZipInfo(name, EPOCH)
    info.external_attr = 0o644 << 16
    archive.writestr(info, content)


def _equal(a: tuple[zipfile.ZipFile, zipfile.ZipInfo], b: tuple[zipfile.ZipFile, zipfile.ZipInfo]) -> bool:
    return a[0].read(a[1]) == b[0].read(b[1])
