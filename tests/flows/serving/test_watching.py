import os
from pathlib import Path
from typing import Any

import pytest

from dg4d_lib.errors import BadInput
from flows.inputs.package_record import RECORD
from flows.serving.results import Results
from flows.serving.watching import Watcher


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "in").mkdir()
    return tmp_path / "in"


def watcher(folder: Path, rest_s: float = 10) -> Watcher:
    return Watcher(folder, folder / "out", rest_s)


def test_a_folder_counts_when_it_has_been_at_rest(folder: Path) -> None:
    looking = watcher(folder)
    assert looking.poll(0) is None
    (folder / "a.png").write_text("a")
    assert looking.poll(1) is None
    (folder / "a.png").write_text("still arriving")
    assert looking.poll(10) is None
    assert looking.poll(19.9) is None
    assert looking.poll(20) is not None


def test_an_empty_folder_is_nothing_to_tell(folder: Path) -> None:
    looking = watcher(folder)
    assert looking.poll(0) is None and looking.poll(100) is None


def test_a_state_is_told_once_and_again_after_a_restart(folder: Path) -> None:
    (folder / "a.png").write_text("a")
    first = watcher(folder, rest_s=0)
    digest = first.poll(0)
    assert digest is not None
    first.mark_announced()
    assert first.poll(1) is None
    (folder / "b.png").write_text("b")
    assert first.poll(2) not in {None, digest}
    first.mark_announced()
    (folder / "b.png").unlink()
    assert first.poll(3) is None
    assert watcher(folder, rest_s=0).poll(0) == digest  # of a run that failed, which goes on


def test_a_busy_folder_is_announced_before_it_comes_to_rest(folder: Path) -> None:
    looking, announced = watcher(folder), list[int]()
    for second in range(700):
        if second % 8 == 0:
            (folder / f"shot-{second}.png").write_text("picture")
        if looking.poll(second) is not None:
            looking.mark_announced()
            announced.append(second)
    assert announced == [300, 604]


def test_a_file_that_still_grows_alone_is_not_announced(folder: Path) -> None:
    looking = watcher(folder)
    for second in range(0, 700, 5):
        (folder / "walk.mp4").write_bytes(bytes(second))
        assert looking.poll(second) is None


def test_files_that_no_batch_reads_do_not_count(folder: Path) -> None:
    (folder / "hero.png").write_text("a")
    looking = watcher(folder)
    for second in range(10):
        (folder / "rsync.log").write_text(str(second))
        assert looking.poll(second) is None
    assert looking.poll(10) is not None
    looking.mark_announced()
    (folder / "model.glb").write_text("m")
    assert looking.poll(11) is None and looking.poll(30) is None
    (folder / "list.csv").write_text("asset\nmodel.glb\n")
    looking.poll(31)
    assert looking.poll(41) is not None


def test_the_manifest_in_a_folder_is_the_input(folder: Path) -> None:
    (folder / "a.png").write_text("a")
    (folder / "below").mkdir()
    (folder / "below" / "cameras.json").write_text("{}")
    looking = watcher(folder, rest_s=0)
    looking.poll(0)
    assert looking.inputs() == folder
    (folder / "List.CSV").write_text("path\na.png\n")
    looking.poll(1)
    assert looking.inputs() == folder / "List.CSV"
    (folder / "more.jsonl").write_text("{}")
    looking.poll(2)
    with pytest.raises(BadInput, match=r"several manifests \(List.CSV, more.jsonl\).*keep one"):
        looking.inputs()


def test_a_file_that_cannot_be_read_stops_no_others(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a.png", "b.png"):
        (folder / name).write_text("a")
    real = Path.open

    def refuse(path: Path, *arguments: Any, **options: Any) -> Any:
        if path.name == "a.png":
            raise PermissionError(path)
        return real(path, *arguments, **options)

    monkeypatch.setattr(Path, "open", refuse)
    assert watcher(folder, rest_s=0).poll(0) is not None  # the batch says which item failed


def test_what_was_not_told_is_given_again(folder: Path) -> None:
    (folder / "a.png").write_text("a")
    looking = watcher(folder, rest_s=0)
    assert looking.poll(0) == looking.poll(1) is not None


def test_packages_hidden_files_and_links_do_not_count(folder: Path) -> None:
    (folder / "a.png").write_text("a")
    digest = watcher(folder, rest_s=0).poll(0)
    (folder / "out").mkdir()
    (folder / "out" / "asset.glb").write_text("made")
    (folder / ".part").write_text("arriving")
    (folder / "link.png").symlink_to(folder / "a.png")
    assert watcher(folder, rest_s=0).poll(0) == digest


def test_a_folder_that_vanishes_during_a_look_is_left_out(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", ".b.incoming-1", "c"):
        (folder / name).mkdir()
        (folder / name / RECORD).write_text("{}")
        (folder / name / "fox.png").write_text("a")
    real = os.scandir

    def scandir(path: os.PathLike[str]) -> "os._ScandirIterator[str]":
        if Path(path).name not in {"in", "a"}:
            raise FileNotFoundError(path)
        return real(path)

    results, looking = Results(folder.parent / "nothing"), watcher(folder, rest_s=0)
    results.out = folder
    monkeypatch.setattr(os, "scandir", scandir)
    assert results.poll() == [f"done: {folder}/a"]
    assert looking.poll(0) is not None
    assert list(looking._stamps()) == ["a/fox.png"]


def test_what_is_no_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="nothing does not exist; give a folder"):
        watcher(tmp_path / "nothing")


@pytest.mark.parametrize("out", ["in", "."])
def test_an_output_folder_that_holds_the_watched_one_is_refused(folder: Path, out: str) -> None:
    with pytest.raises(BadInput, match="holds the watched folder"):
        Watcher(folder, folder.parent / out, 10.0)
