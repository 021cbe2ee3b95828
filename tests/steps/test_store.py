import errno
import hashlib
import os
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest

from dg4d_lib.errors import BadInput
from steps.contract import ArtifactRef
from steps.store import artifact_store as module
from steps.store.artifact_store import ArtifactMissing, ArtifactStore
from steps.store.files import DiskFull, home, make_folders_absolute, walk, write_atomically


@pytest.fixture
def store(tmp_path: Path) -> ArtifactStore:
    return ArtifactStore(tmp_path / "store")


def files_in(store: ArtifactStore) -> list[Path]:
    return sorted(p for p in store.root.rglob("*") if p.is_file())


def test_what_was_put_comes_back(store: ArtifactStore, tmp_path: Path) -> None:
    content = bytes(range(256)) * 10_000
    (tmp_path / "a").write_bytes(content)
    ref = store.put(tmp_path / "a", "x/y")
    store.get(ref, tmp_path / "b")
    assert (tmp_path / "b").read_bytes() == content
    assert ref.size_bytes == len(content)
    assert ref == store.put_bytes(content, "x/y")


def test_a_name_is_the_sha256_of_the_content(store: ArtifactStore) -> None:
    ref = store.put_bytes(b"abc", "text/plain")  # FIPS 180-2, appendix B.1
    assert ref.digest == "sha256:ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"


def test_equal_content_is_kept_once(store: ArtifactStore) -> None:
    store.put_bytes(b"same", "a/b")
    store.put_bytes(b"same", "c/d")
    assert len(files_in(store)) == 1


def test_equal_content_is_not_written_again_and_young_again(store: ArtifactStore, tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"same")
    kept = store.path(store.put(tmp_path / "a", "a/b"))
    before = kept.stat()
    os.utime(kept, (1, 1))
    ref = store.put(tmp_path / "a", "a/b")
    assert kept.stat().st_ino == before.st_ino and kept.stat().st_mtime >= before.st_mtime - 1
    assert store.is_sound(ref)
    kept.chmod(0o600)
    kept.write_bytes(b"bent")  # of the same size
    os.utime(kept, (1, 1))
    assert store.put(tmp_path / "a", "a/b") == ref and kept.read_bytes() == b"same"


def test_the_store_of_another_user_is_refused(
    store: ArtifactStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ref = store.put_bytes(b"precious", "a/b")
    real = Path.open

    def closed(path: Path, mode: str = "r", **options: Any) -> Any:
        if path.is_relative_to(store.root):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return real(path, mode, **options)

    real_stat = Path.stat

    def hidden(path: Path, **options: Any) -> os.stat_result:
        if path == kept:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return real_stat(path, **options)

    def fixed(path: Path, **_: Any) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))

    kept = store.path(ref)
    monkeypatch.setattr(Path, "open", closed)
    monkeypatch.setattr(Path, "unlink", fixed)
    monkeypatch.setattr(Path, "owner", lambda _: "ana")
    with monkeypatch.context() as private, pytest.raises(BadInput, match="belongs to the user ana"):
        private.setattr(Path, "stat", hidden)
        store.has(ref)
    for use in (
        lambda: store.content_digest(ref.digest),
        lambda: store.read("records/a"),
        lambda: store.create("records/b", "1"),
        lambda: store.remove(["records/a"]),
        lambda: store.path(ref),
        lambda: store.get(ref, tmp_path / "b"),
        lambda: store.put_bytes(b"precious", "a/b"),
        lambda: store.write("records/a", "1"),
    ):
        with pytest.raises(BadInput, match=r"store .* belongs to the user ana.*one user; set \$DG4D_STORE"):
            use()


def test_changing_a_fetched_file_leaves_the_store_as_it_was(store: ArtifactStore, tmp_path: Path) -> None:
    ref = store.put_bytes(b"precious", "a/b")
    store.get(ref, tmp_path / "mine")
    (tmp_path / "mine").write_bytes(b"scribble")
    assert store.path(ref).read_bytes() == b"precious"
    assert store.path(ref).stat().st_mode & 0o222 == 0


def test_a_truncated_artifact_is_missing_and_putting_it_again_heals_it(store: ArtifactStore) -> None:
    ref = store.put_bytes(b"0123456789", "a/b")
    store.path(ref).chmod(0o644)
    os.truncate(store.path(ref), 4)
    assert not store.has(ref)
    with pytest.raises(ArtifactMissing, match="run the same command again"):
        store.path(ref)
    store.put_bytes(b"0123456789", "a/b")
    assert store.path(ref).read_bytes() == b"0123456789"


def test_a_damaged_artifact_is_refused_and_dropped(store: ArtifactStore, tmp_path: Path) -> None:
    ref = store.put_bytes(b"0123456789", "a/b")
    store.path(ref).chmod(0o644)
    store.path(ref).write_bytes(b"0123X56789")  # the size is right
    with pytest.raises(ArtifactMissing, match="damaged"):
        store.get(ref, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert not store.has(ref)


def test_unchanged_files_are_read_once_also_after_equal_content_was_put(
    store: ArtifactStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    ref, reads, read = store.put_bytes(b"same", "a/b"), [], hashlib.file_digest

    def counted(file: Any, algorithm: str) -> Any:
        reads.append(file.name)
        return read(file, algorithm)

    monkeypatch.setattr(module.hashlib, "file_digest", counted)
    kept = store.path(ref)
    assert store.path(ref) == kept and store.is_sound(ref)
    assert len(reads) == 1
    os.utime(kept, (1, 1))
    assert store.put_bytes(b"same", "a/b") == ref
    assert len(reads) == 2  # since the time was another
    assert store.path(ref).read_bytes() == b"same" and store.is_sound(ref)
    assert len(reads) == 2


@pytest.mark.parametrize(("read_s", "written_s", "stays"), [(0, 900, True), (900, 0, True), (900, 900, False)])
def test_partial_files_go_when_they_were_neither_read_nor_written_for_a_while(
    store: ArtifactStore, read_s: float, written_s: float, stays: bool
) -> None:
    store.write("incoming/new", "half")
    partial = store.root / "incoming" / "new"
    now = time.time()
    os.utime(partial, (now - read_s, now - written_s))
    store.tidy(600)
    assert partial.exists() == stays


def test_a_reference_to_nothing_is_missing(store: ArtifactStore) -> None:
    ref = ArtifactRef(digest="sha256:" + "0" * 64, media_type="a/b", size_bytes=1)
    assert not store.has(ref)
    with pytest.raises(ArtifactMissing):
        store.path(ref)


def test_a_full_disk_is_one_clear_error_and_leaves_nothing(
    store: ArtifactStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = store.put_bytes(b"kept", "a/b")

    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(module.os, "fsync", full)
    with pytest.raises(DiskFull, match="free some space"):
        store.put_bytes(b"too much", "a/b")
    assert [p.name for p in files_in(store)] == [kept.digest[7:]]
    (tmp_path / "state").write_text("old")
    with pytest.raises(DiskFull):
        write_atomically(tmp_path / "state", "new")
    assert (tmp_path / "state").read_text() == "old"
    assert [p.name for p in tmp_path.iterdir() if p.is_file()] == ["state"]


def test_a_new_file_that_there_is_no_room_for_is_not_created(
    store: ArtifactStore, no_room: AbstractContextManager[None]
) -> None:
    store.write("a/one.json", "1")
    with no_room, pytest.raises(OSError, match="too large"):
        store.create("a/two.json", "2")
    assert [path.name for path in files_in(store)] == ["one.json"]


def test_another_trouble_with_a_file_is_not_called_a_full_disk(store: ArtifactStore, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        store.put(tmp_path / "nothing", "a/b")


def test_home_is_where_the_environment_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "h"))
    assert home() == tmp_path / "h"
    monkeypatch.delenv("DG4D_HOME")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "x"))
    assert home() == tmp_path / "x" / "dg4d"
    monkeypatch.delenv("XDG_DATA_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert home() == tmp_path / ".local" / "share" / "dg4d"


@pytest.mark.parametrize(
    ("given", "then"),
    [("a/b", "{here}/a/b"), ("/a", "/a"), ("~/a", "/me/a"), ("s3://bucket/p", "s3://bucket/p"), ("", "")],
)
def test_folders_of_the_environment_are_the_same_for_processes_in_other_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str, then: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/me")
    monkeypatch.setenv("DG4D_STORE", given)
    make_folders_absolute()
    assert os.environ["DG4D_STORE"] == then.format(here=tmp_path)


def test_threads_that_write_one_file_at_once_leave_one_whole_content(tmp_path: Path) -> None:
    contents = [letter * 100_000 for letter in "abcdefgh"]
    with ThreadPoolExecutor(8) as threads:
        list(threads.map(lambda content: write_atomically(tmp_path / "state", content), contents * 4))
    assert (tmp_path / "state").read_text() in contents
    assert [path.name for path in tmp_path.iterdir()] == ["state"]


def test_a_folder_that_vanishes_while_it_is_listed_is_left_out(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name / "deep").mkdir(parents=True)
        (tmp_path / name / "deep" / "file").touch()
    found = walk(tmp_path)
    first = [next(found), next(found)]
    assert {path.name for path in first} == {"a", "b"}
    shutil.rmtree(tmp_path / "b")
    assert list(found) == [tmp_path / "a" / "deep", tmp_path / "a" / "deep" / "file"]
