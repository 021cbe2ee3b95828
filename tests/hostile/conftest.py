"""A place of its own for every hostile command: a home, an output folder and a folder for temporary files."""

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.hostile import archives, banks, pictures, videos


@dataclass(frozen=True)
class Place:
    """Folders of one test.

    Attributes:
        work: the current folder, with the files that `options.py` names.
        home: `$DG4D_HOME`.
        temporary: `$TMPDIR`.
    """

    work: Path
    home: Path
    temporary: Path

    def stored(self) -> list[str]:
        """List the blobs in the store."""
        return sorted(path.name for path in (self.home / "store").rglob("*") if path.is_file() and len(path.name) >= 60)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Place]:
    """Move into an empty folder; afterwards nothing may be left in the folder for temporary files."""
    found = Place(tmp_path / "work", tmp_path / "home", tmp_path / "temporary")
    found.work.mkdir()
    found.temporary.mkdir()
    monkeypatch.setenv("DG4D_HOME", str(found.home))
    monkeypatch.setenv("TMPDIR", str(found.temporary))
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr(tempfile, "tempdir", str(found.temporary))
    monkeypatch.chdir(found.work)
    yield found
    left = (path.name for path in found.temporary.rglob("*"))
    assert sorted(name for name in left if not name.startswith("torchinductor_")) == []  # torch makes that one


@pytest.fixture(scope="session")
def samples() -> dict[str, bytes]:
    """Return the sound files that commands are given."""
    return {"cat.png": pictures.sound_png(), "run.mp4": videos.film(), "run.zip": archives.packed(archives.numbered(3))}


@pytest.fixture
def furnished(place: Place, samples: dict[str, bytes]) -> Place:
    """Put what `options.py` names into the current folder."""
    for name in ("cat.png", "run.mp4"):
        (place.work / name).write_bytes(samples[name])
    (place.work / "pets").mkdir()
    (place.work / "pets" / "dog.png").write_bytes(samples["cat.png"])
    (place.work / "thesis").mkdir()
    (place.work / "thesis" / "one.doc").write_text("mine")
    (place.work / "broken.json").write_text("{")
    (place.work / "cube.glb").write_bytes(b"glTF")
    banks.bank()(place.work / "bank")
    return place
