import zipfile
from pathlib import Path

import pytest

from flows.engine.frames import count_frames, divide_frames
from steps.store.artifact_store import ArtifactStore


@pytest.fixture
def store(tmp_path: Path) -> ArtifactStore:
    return ArtifactStore(tmp_path / "store")


def test_only_pictures_are_frames(store: ArtifactStore, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "f.zip", "w") as archive:
        for name in ("000.png", "001.png", "video.json"):
            archive.writestr(name, "x")
    assert count_frames(store.put(tmp_path / "f.zip", "application/zip"), store) == 2


@pytest.mark.parametrize(("frames", "tasks", "sizes"), [(14, 4, [4, 3, 4, 3]), (3, 8, [1, 1, 1]), (5, 1, [5])])
def test_frames_are_divided_evenly(frames: int, tasks: int, sizes: list[int]) -> None:
    parts = divide_frames(frames, tasks)
    assert [part.end_frame - part.first_frame for part in parts] == sizes
    assert [part.first_frame for part in parts[1:]] == [part.end_frame for part in parts[:-1]]
    assert parts[0].first_frame == 0 and parts[-1].end_frame == frames
    assert [str(part) for part in parts] == [f"{number}/{len(sizes)}" for number in range(1, len(sizes) + 1)]
