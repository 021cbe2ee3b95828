import os
from pathlib import Path

import pytest

from dg4d_lib.errors import BadInput
from flows.serving.results import RECORD, Results
from flows.serving.watching import Watcher


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "in").mkdir()
    return tmp_path / "in"


def watcher(folder: Path, rest_s: float = 10) -> Watcher:
    return Watcher(folder, folder / "out", rest_s, folder.parent / "state" / "told")


def test_a_folder_counts_when_it_has_been_at_rest(folder: Path) -> None:
    looking = watcher(folder)
    assert looking.look(0) is None
    (folder / "a.png").write_text("a")
    assert looking.look(1) is None
    (folder / "a.png").write_text("still arriving")
    assert looking.look(10) is None
    assert looking.look(19.9) is None
    assert looking.look(20) is not None


def test_an_empty_folder_is_nothing_to_tell(folder: Path) -> None:
    looking = watcher(folder)
    assert looking.look(0) is None and looking.look(100) is None


def test_the_same_content_is_told_once_also_after_a_restart(folder: Path) -> None:
    (folder / "a.png").write_text("a")
    first = watcher(folder, rest_s=0)
    digest = first.look(0)
    assert digest is not None
    first.told(digest)
    assert first.look(1) is None
    (folder / "a.png").touch()  # another time, the same bytes
    assert watcher(folder, rest_s=0).look(0) is None
    (folder / "b.png").write_text("b")
    assert watcher(folder, rest_s=0).look(0) not in {None, digest}


def test_what_was_not_told_is_given_again(folder: Path) -> None:
    (folder / "a.png").write_text("a")
    looking = watcher(folder, rest_s=0)
    assert looking.look(0) == looking.look(1) is not None


def test_packages_hidden_files_and_links_do_not_count(folder: Path) -> None:
    (folder / "a.png").write_text("a")
    digest = watcher(folder, rest_s=0).look(0)
    (folder / "out").mkdir()
    (folder / "out" / "asset.glb").write_text("made")
    (folder / ".part").write_text("arriving")
    (folder / "link.png").symlink_to(folder / "a.png")
    assert watcher(folder, rest_s=0).look(0) == digest


def test_a_folder_that_vanishes_during_a_look_is_left_out(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", ".b.incoming-1", "c"):
        (folder / name).mkdir()
        (folder / name / RECORD).write_text("{}")
    real = os.scandir

    def scandir(path: os.PathLike[str]) -> "os._ScandirIterator[str]":
        if Path(path).name not in {"in", "a"}:
            raise FileNotFoundError(path)
        return real(path)

    results, looking = Results(folder.parent / "nothing"), watcher(folder, rest_s=0)
    results.out = folder
    monkeypatch.setattr(os, "scandir", scandir)
    assert results.look() == [f"done: {folder}/a"]
    assert looking.look(0) is not None
    assert list(looking._stamps) == [f"a/{RECORD}"]


def test_what_is_no_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="is not a folder"):
        watcher(tmp_path / "nothing")
