import time
import unicodedata
from pathlib import Path
from typing import get_args

import pytest

from dg4d_lib.errors import BadInput
from flows.inputs.naming import (
    LONGEST_PART_BYTES,
    check_folder_name,
    check_name,
    check_not_reserved,
    check_path,
    name_from_path,
    unique_names,
)
from flows.packages.publish import Scratch, scratch_name


@pytest.mark.parametrize("letter", ["a", "é", "猫", "🦎"])
def test_bytes_count_and_not_letters(letter: str) -> None:
    most = LONGEST_PART_BYTES // len(letter.encode())
    check_name(f"{letter * most}/{letter * most}")
    with pytest.raises(BadInput, match=f"at most {LONGEST_PART_BYTES} are allowed"):
        check_name(f"x/{letter * (most + 1)}")


def test_every_name_that_is_allowed_leaves_room_for_the_names_of_scratch_folders(tmp_path: Path) -> None:
    longest = "n" * LONGEST_PART_BYTES
    incoming, outgoing = (scratch_name(Path(longest), kind, 4194304) for kind in get_args(Scratch))
    for name in (incoming, outgoing, f"{longest}-motions"):
        (tmp_path / name).mkdir()


def test_a_file_gives_its_stem_and_a_folder_its_whole_name(tmp_path: Path) -> None:
    (tmp_path / "run.v2").mkdir()
    (tmp_path / "fox.v2.png").touch()
    assert name_from_path(tmp_path / "run.v2") == "run.v2"
    assert name_from_path(tmp_path / "fox.v2.png") == "fox.v2"
    assert name_from_path(Path("no file.mp4")) == "no file"
    assert name_from_path(Path(f"{'x' * 5000}.png")) == "x" * 5000  # longer than a file system looks up
    assert name_from_path(Path()) == "asset"


@pytest.mark.parametrize("name", ["", "..", "/", "a\nb", "a\x1b[31mb", "a\u202eb", "a\0b"])
def test_a_name_of_letters_that_cannot_be_seen_is_refused(name: str) -> None:
    with pytest.raises(BadInput, match="use printable characters"):
        check_name(name)


@pytest.mark.parametrize("name", ["caf\udce9", "\ud800"])
def test_a_name_that_is_not_utf_8_is_refused_in_a_message_that_is(name: str) -> None:
    with pytest.raises(BadInput, match="is not UTF-8") as refused:
        check_name(name)
    str(refused.value).encode()


def test_a_name_with_very_many_folders_is_refused() -> None:
    with pytest.raises(BadInput, match="with its folders"):
        check_name("/".join(["folder"] * 500))


@pytest.mark.parametrize("name", ["summary.json", "Index.HTML", "summary.csv/deep"])
def test_the_names_of_the_files_of_a_batch_are_taken(name: str) -> None:
    with pytest.raises(BadInput, match="every batch writes"):
        check_not_reserved(name)
    check_not_reserved("deep/summary.json")


def test_paths_that_no_system_can_look_up_are_refused() -> None:
    check_path(Path("nothing/there"))
    for path in ("x" * 300, "a/" * 3000, "zero\0byte", "half\ud800"):
        with pytest.raises(BadInput, match="cannot be read") as refused:
            check_path(Path(path))
        assert len(str(refused.value)) < 200


def test_output_folders_that_leave_no_room_are_refused() -> None:
    check_folder_name(Path("x" * LONGEST_PART_BYTES))
    for path in ("x" * (LONGEST_PART_BYTES + 1), "猫" * 80, "a/" * 2000, "zero\0byte"):
        with pytest.raises(BadInput, match="cannot be written"):
            check_folder_name(Path(path))


def test_names_differ_on_every_file_system() -> None:
    composed, decomposed = (unicodedata.normalize(form, "café") for form in ("NFC", "NFD"))
    assert composed != decomposed
    names = unique_names([(composed, "png"), (decomposed, "jpg"), ("STRASSE", "png"), ("straße", "jpg")])
    assert names == [f"{composed}-png", f"{decomposed}-jpg", "STRASSE-png", "straße-jpg"]


def test_thousands_of_equal_names_are_numbered_in_a_moment() -> None:
    start = time.process_time()
    assert unique_names([("x", "")] * 20_000)[-1] == "x-20000"
    assert time.process_time() - start < 2  # measured 0.1 s; every pair compared would take minutes
