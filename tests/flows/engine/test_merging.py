import zipfile
from pathlib import Path

import pytest

from flows.engine.merging import frames_in
from steps.store.artifact_store import ArtifactStore


@pytest.fixture
def store(tmp_path: Path) -> ArtifactStore:
    return ArtifactStore(tmp_path / "store")


def test_only_pictures_are_frames(store: ArtifactStore, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "f.zip", "w") as archive:
        for name in ("000.png", "001.png", "video.json"):
            archive.writestr(name, "x")
    assert frames_in(store.put(tmp_path / "f.zip", "application/zip"), store) == 2
