import errno
import json
import os
import time
import zipfile
from pathlib import Path

import pytest

from dg4d_lib.errors import BadInput
from flows.engine.output_lock import is_up_to_date
from flows.inputs.package_record import RECORD, record_of
from flows.packages.publish import (
    Files,
    check_folder,
    is_current,
    leftovers,
    load_verified,
    publish,
    scratch_name,
)
from flows.packages.verify import verify
from steps.store.files import DiskFull


def zipped(path: Path, **entries: str) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in entries.items():
            archive.writestr(name.replace("__", "/").replace("_dot_", "."), content)
    return path


def finish(folder: Path, files: Files) -> Files:
    (folder / "provenance.json").write_text(json.dumps({"order": "o1", "files": files, "beside": ["report.html"]}))
    (folder / "report.html").write_text("r")
    return files


def tree(folder: Path) -> dict[str, str]:
    return {
        p.relative_to(folder).as_posix(): p.read_bytes().decode("latin-1")
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }


@pytest.fixture
def package(tmp_path: Path) -> Path:
    return zipped(tmp_path / "package.zip", asset_dot_glb="mesh", splats__000_dot_ply="s0")


def test_a_package_appears_with_what_goes_with_it(package: Path, tmp_path: Path) -> None:
    files = publish(package, tmp_path / "deep" / "out", finish)
    assert set(files) == {"asset.glb", "splats/000.ply"}
    assert set(tree(tmp_path / "deep" / "out")) == {*files, "provenance.json", "report.html"}
    assert is_current(tmp_path / "deep" / "out", "o1")
    assert not is_current(tmp_path / "deep" / "out", "o2")
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["out"]


def test_a_new_package_replaces_the_old_and_keeps_files_of_the_user(package: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    publish(package, out, finish)
    (out / "renders").mkdir()
    (out / "renders" / "mine.png").write_text("mine")
    publish(zipped(tmp_path / "other.zip", asset_dot_glb="new"), out, finish)
    assert tree(out)["asset.glb"] == "new"
    assert tree(out)["renders/mine.png"] == "mine"
    assert "splats/000.ply" not in tree(out)
    assert is_current(out, "o1")


@pytest.mark.parametrize("in_place", [False, True], ids=["renamed", "in place"])
def test_a_file_of_the_user_is_kept_when_a_later_package_brings_one_of_its_name(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_place: bool
) -> None:
    out, said = tmp_path / "out", list[str]()
    publish(package, out, finish)
    for name in ("asset_rigged.glb", "asset_rigged.mine.glb", "same.glb", "meshes"):
        (out / name).write_text(f"{name} of hours of work")
    (out / "same.glb").write_text("equal")
    (out / "sheet.png").mkdir()
    for name in ("own.txt", "other.txt"):
        (out / "sheet.png" / name).write_text("a folder")
    if in_place:
        monkeypatch.chdir(out)
    new = {"asset_rigged": "new", "same": "equal", "meshes__000": "mesh"}
    entries = {f"{name}_dot_glb": content for name, content in new.items()}
    archive = zipped(tmp_path / "other.zip", **entries, sheet_dot_png="sheet")
    publish(archive, out, finish, said.append)
    assert set(tree(out)) == {
        "asset_rigged.glb", "same.glb", "meshes/000.glb", "sheet.png", "provenance.json", "report.html",
        "asset_rigged.mine.glb", "asset_rigged.mine-2.glb", "meshes.mine", "sheet.mine.png/own.txt",
        "sheet.mine.png/other.txt",
    }  # fmt: skip
    assert tree(out)["asset_rigged.glb"] == "new"
    kept = {tree(out)["asset_rigged.mine.glb"], tree(out)["asset_rigged.mine-2.glb"]}
    assert kept == {"asset_rigged.glb of hours of work", "asset_rigged.mine.glb of hours of work"}
    assert len(said) == (3 if in_place else 4) and all("your own file" in text for text in said)
    assert is_current(out, "o1")


def test_a_package_without_its_report_is_not_current(package: Path, tmp_path: Path) -> None:
    publish(package, tmp_path / "out", finish)
    (tmp_path / "out" / "report.html").unlink()
    assert not is_current(tmp_path / "out", "o1")


@pytest.mark.parametrize("name", ["../mine.txt", "a" * 256, "a/" * 600 + "a"])
@pytest.mark.parametrize("where", ["files", "beside"])
def test_a_record_whose_names_lead_outside_or_cannot_exist_is_none(
    package: Path, tmp_path: Path, where: str, name: str
) -> None:
    out = tmp_path / "out"
    publish(package, out, finish)
    record = json.loads((out / "provenance.json").read_text())
    record[where] = {name: {}}
    (out / "provenance.json").write_text(json.dumps(record))
    assert record_of(out) is None
    with pytest.raises(BadInput, match="holds other files"):
        check_folder(out)


@pytest.mark.parametrize("where", ["files", "beside"])
def test_a_name_that_is_too_long_with_its_folder_is_missing_or_altered(tmp_path: Path, where: str) -> None:
    out = tmp_path.joinpath(*["f" * 200] * 17)
    out.mkdir(parents=True)
    name = "/".join(["n" * 200] * 4)
    record = {"order": "o1", "format": 2, "files": {}, "beside": []}
    record[where] = {name: {"digest": "", "size_bytes": 0}} if where == "files" else [name]
    (out / "provenance.json").write_text(json.dumps(record))
    assert record_of(out) is not None and not is_current(out, "o1")
    faults = [(check.kind, check.name) for check in verify(out).checks if check.fault]
    assert ("file", name) in faults or ("file", "provenance.json") in faults


@pytest.mark.parametrize("damage", ["change", "delete", "truncate"])
def test_a_damaged_package_is_not_current(package: Path, tmp_path: Path, damage: str) -> None:
    publish(package, tmp_path / "out", finish)
    file = tmp_path / "out" / "asset.glb"
    {"change": lambda: file.write_text("MESH"), "delete": file.unlink, "truncate": lambda: os.truncate(file, 1)}[
        damage
    ]()
    assert not is_current(tmp_path / "out", "o1")


def test_a_full_disk_leaves_the_old_package_whole_and_nothing_else(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish(package, tmp_path / "out", finish)
    before = tree(tmp_path)

    def full(source: object, target: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("shutil.copyfileobj", full)
    with pytest.raises(DiskFull, match="free some space"):
        publish(package, tmp_path / "out", finish)
    with pytest.raises(DiskFull):
        publish(package, tmp_path / "new" / "out", finish)
    assert tree(tmp_path) == before
    assert not (tmp_path / "new").exists()


def test_a_folder_that_cannot_be_renamed_is_filled_in_place(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    publish(package, out, finish)
    monkeypatch.chdir(out)  # a user who stands in the folder must not find it gone
    inode = out.stat().st_ino
    publish(zipped(tmp_path / "other.zip", asset_dot_glb="new"), out, finish)
    assert out.stat().st_ino == inode
    assert set(tree(out)) == {"asset.glb", "provenance.json", "report.html"}
    assert is_current(out, "o1")


def test_what_a_killed_command_left_is_cleared_up_or_put_back(package: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    publish(package, out, finish)
    (out / "notes.txt").write_text("mine")
    dead = 2**22 + 1  # above the largest number a process can have
    out.rename(tmp_path / scratch_name(out, "outgoing", dead))  # killed between the two renames
    (tmp_path / scratch_name(out, "incoming", dead)).mkdir()
    publish(package, out, finish)
    assert tree(out)["notes.txt"] == "mine"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out", "package.zip"]


@pytest.mark.parametrize("place", ["", "out"], ids=["beside the folder", "in the folder"])
def test_a_package_that_is_up_to_date_gets_back_the_users_files_that_a_killed_command_left_aside(
    package: Path, tmp_path: Path, place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "home"))
    out, dead = tmp_path / "out", 2**22 + 1
    publish(package, out, finish)
    left = tmp_path / place / scratch_name(out, "outgoing", dead)
    publish(package, left, finish)
    (left / "notes.txt").write_text("mine")
    (tmp_path / place / scratch_name(out, "incoming", dead)).mkdir()
    assert not is_up_to_date(out, "o2") and left.exists()
    assert is_up_to_date(out, "o1") and is_up_to_date(out, "o1")
    assert tree(out)["notes.txt"] == "mine"
    assert [path.name for path in (tmp_path / place).glob(".out.*")] == []


def test_what_a_killed_process_of_the_same_number_left_does_not_block(package: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    publish(package, out, finish)
    left = tmp_path / scratch_name(out, "outgoing", os.getpid())  # as in a container, whose commands have one number
    left.mkdir()
    (left / "notes.txt").write_text("mine")
    publish(package, out, finish)
    assert tree(out)["notes.txt"] == "mine" and not left.exists()


def test_what_another_machine_writes_stays_until_it_has_not_changed_for_a_day(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, dead = tmp_path / "out", 2**22 + 1
    monkeypatch.setenv("DG4D_HOST_ID", "another")
    foreign = tmp_path / scratch_name(out, "incoming", dead)
    monkeypatch.setenv("DG4D_HOST_ID", "this")
    (foreign / "meshes").mkdir(parents=True)
    assert scratch_name(out, "incoming", dead) != foreign.name
    publish(package, out, finish)
    assert foreign.is_dir() and leftovers(out) == []
    later = time.time() + 25 * 3600
    monkeypatch.setattr("flows.packages.publish.time.time", lambda: later)
    (foreign / "meshes" / "000.glb").touch()
    os.utime(foreign / "meshes" / "000.glb", (later, later))
    assert leftovers(out) == []
    (foreign / "meshes" / "000.glb").unlink()
    publish(package, out, finish)
    assert not foreign.exists()


def test_a_scratch_folder_that_another_machine_removes_meanwhile_is_not_left_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / ".out.outgoing-another-1").mkdir()
    real = Path.lstat

    def lstat(path: Path) -> os.stat_result:
        if ".outgoing-" in path.name:
            raise FileNotFoundError(path)
        return real(path)

    monkeypatch.setattr(Path, "lstat", lstat)
    assert leftovers(tmp_path / "out") == []


def test_a_pipe_is_no_package_and_has_no_digest(package: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    publish(package, out, finish)
    (out / "asset.glb").unlink()
    os.mkfifo(out / "asset.glb")
    with pytest.raises(BadInput, match=r"asset.glb cannot be read \(not a regular file\)"):
        load_verified(out)
    (out / RECORD).unlink()
    os.mkfifo(out / RECORD)
    assert record_of(out) is None


def test_an_entry_outside_the_package_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "evil.zip", "w") as archive:
        archive.writestr("../evil.txt", "x")
    with pytest.raises(BadInput, match="outside"):
        publish(tmp_path / "evil.zip", tmp_path / "out", finish)
    assert not (tmp_path / "evil.txt").exists()
    assert not (tmp_path / "out").exists()


def test_a_folder_with_other_files_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.doc").write_text("years of work")
    with pytest.raises(BadInput, match=r"thesis\.doc"):
        check_folder(tmp_path)


def test_a_circle_of_links_is_refused(tmp_path: Path) -> None:
    (tmp_path / "circle").symlink_to("circle")
    for folder in (tmp_path / "circle", tmp_path / "circle" / "out"):
        with pytest.raises(BadInput, match=r"cannot be written: .*loop"):
            check_folder(folder)


def test_a_file_or_a_place_under_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match="is a file"):
        check_folder(tmp_path / "file")
    with pytest.raises(BadInput, match="cannot be written"):
        check_folder(tmp_path / "file" / "out")


def test_looking_at_a_folder_leaves_nothing_there(tmp_path: Path) -> None:
    check_folder(tmp_path / "a" / "b")
    assert list(tmp_path.iterdir()) == []
    assert record_of(tmp_path) is None
