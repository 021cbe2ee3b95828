import zipfile
from pathlib import Path

import pytest

from flows.engine.merging import frames_in, merged
from steps.contract import ArtifactRef
from steps.store import ArtifactStore


@pytest.fixture
def store(tmp_path: Path) -> ArtifactStore:
    return ArtifactStore(tmp_path / "store")


def part(store: ArtifactStore, tmp_path: Path, **entries: str) -> ArtifactRef:
    with zipfile.ZipFile(tmp_path / "part.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(f"{name[1:]}.safetensors", content)
    return store.put(tmp_path / "part.zip", "application/zip")


def test_parts_become_one_whatever_their_order(store: ArtifactStore, tmp_path: Path) -> None:
    one, two = part(store, tmp_path, _000="a", _001="b"), part(store, tmp_path, _002="c")
    whole = merged([two, one], store)
    assert whole == merged([one, two], store)
    assert whole == merged([part(store, tmp_path, _000="a", _001="b", _002="c")], store)
    with zipfile.ZipFile(store.path(whole)) as archive:
        assert archive.namelist() == ["000.safetensors", "001.safetensors", "002.safetensors"]
        assert archive.read("002.safetensors") == b"c"


def test_parts_that_contradict_each_other_are_refused(store: ArtifactStore, tmp_path: Path) -> None:
    one, two = part(store, tmp_path, _000="a"), part(store, tmp_path, _000="b")
    with pytest.raises(ValueError, match=r"000\.safetensors"):
        merged([one, two], store)


def test_only_pictures_are_frames(store: ArtifactStore, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "f.zip", "w") as archive:
        for name in ("000.png", "001.png", "video.json"):
            archive.writestr(name, "x")
    assert frames_in(store.put(tmp_path / "f.zip", "application/zip"), store) == 2
