"""A zip that somebody else wrote stays inside its folder, or is refused before a byte of it is written."""

import stat
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from dg4d_lib.errors import BadInput
from steps.artifacts import archives
from steps.artifacts.archives import can_exist, stays_inside, unpack

Write = Callable[[zipfile.ZipFile], None]


def linked(archive: zipfile.ZipFile) -> None:
    entry = zipfile.ZipInfo("link")
    entry.create_system = 3  # Unix: the mode is in the attributes
    entry.external_attr = (stat.S_IFLNK | 0o777) << 16
    archive.writestr(entry, "/etc/passwd")


def twice(archive: zipfile.ZipFile) -> None:
    archive.writestr("same.txt", "one")
    with pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("same.txt", "other")


def made(path: Path, write: Write) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("first.txt", "a good entry")
        write(archive)
    return path


def named(name: str) -> Write:
    return lambda archive: archive.writestr(name, "bad")


@pytest.mark.parametrize(
    ("write", "says"),
    [
        (named("../up.txt"), r"outside itself: '../up.txt'"),
        (named("a/../../up.txt"), "outside itself"),
        (named("/abs.txt"), "outside itself"),
        (named("a\\..\\up.txt"), "outside itself"),
        (named("C:evil.txt"), "outside itself"),
        (linked, "has a link in it, 'link'"),
        (twice, "two entries 'same.txt'"),
    ],
)
def test_a_bad_entry_is_named_and_nothing_is_unpacked(tmp_path: Path, write: Write, says: str) -> None:
    archive, folder = made(tmp_path / "bad.zip", write), tmp_path / "deep" / "folder"
    folder.mkdir(parents=True)
    with pytest.raises(BadInput, match=says):
        unpack(archive, folder, "the zip")
    assert not list(folder.iterdir())
    assert {path.name for path in tmp_path.iterdir()} == {"bad.zip", "deep"}


def test_good_entries_are_unpacked_in_order_and_only_those_that_are_wanted(tmp_path: Path) -> None:
    archive = made(tmp_path / "good.zip", lambda archive: archive.writestr("a/b.png", b"\x00\x01"))
    folder = tmp_path / "folder"
    folder.mkdir()
    assert unpack(archive, folder, "the zip") == ["a/b.png", "first.txt"]
    assert (folder / "a/b.png").read_bytes() == b"\x00\x01"
    assert unpack(archive, folder, "the zip", lambda name: name.endswith(".txt")) == ["first.txt"]


@pytest.mark.parametrize(
    ("limit", "most", "says"),
    [("MOST_ENTRIES", 1, "has 2 entries; at most 1"), ("MOST_UNPACKED_BYTES", 10, "unpacks to 15 bytes; at most 10")],
)
def test_there_is_an_end_to_what_is_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, most: int, says: str
) -> None:
    archive = made(tmp_path / "big.zip", named("more.txt"))
    monkeypatch.setattr(archives, limit, most)
    with pytest.raises(BadInput, match=says):
        unpack(archive, tmp_path, "the zip")


def test_an_entry_that_lies_about_its_size_is_not_read_beyond_it(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("bomb", b"\0" * 1_000_000)
    content = (tmp_path / "bomb.zip").read_bytes()
    real, lie = (1_000_000).to_bytes(4, "little"), (10).to_bytes(4, "little")
    (tmp_path / "bomb.zip").write_bytes(content.replace(real, lie))
    with pytest.raises(BadInput, match="broken"):
        unpack(tmp_path / "bomb.zip", tmp_path, "the zip")
    assert not (tmp_path / "bomb").exists() or (tmp_path / "bomb").stat().st_size <= 10


def test_what_is_no_zip_is_said_so(tmp_path: Path) -> None:
    (tmp_path / "no.zip").write_text("no zip")
    with pytest.raises(BadInput, match="the zip is broken, encrypted, or not a zip"):
        unpack(tmp_path / "no.zip", tmp_path, "the zip")


@pytest.mark.parametrize(
    ("name", "stays"),
    [
        ("a.png", True),
        ("a/b.png", True),
        ("..a/b..", True),
        ("", False),
        (".", False),
        ("a//b", False),
        ("a/./b", False),
        ("a/..", False),
        ("a\nb", False),
        ("a/b/", False),
    ],
)
def test_names_that_stay(name: str, stays: bool) -> None:
    assert stays_inside(name) is stays


@pytest.mark.parametrize(
    ("name", "can"),
    [
        ("a" * 255, True),
        ("a" * 256, False),
        ("\u00e9" * 128, False),
        ("a/" * 511 + "a", True),
        ("a/" * 512 + "a", False),
    ],
)
def test_names_that_are_short_enough_for_a_file(name: str, can: bool) -> None:
    assert can_exist(name) is can
