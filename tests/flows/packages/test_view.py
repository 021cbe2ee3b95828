"""Looking at a package: it is checked first, and its page is what its files say."""

import json
import webbrowser
import zipfile
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from made_package import made_package
from signing import identity

from dg4d_lib.errors import BadInput
from flows.inputs.package_record import RECORD
from flows.packages import view as module
from flows.packages.publish import Files, publish
from flows.packages.verify import verify
from flows.packages.view import VIEWER, view, viewer_facts, viewer_html, viewer_of_artifact, viewer_of_package

CONTENT = {"asset.json": b"{}", "asset.glb": b"glTF", "splats/moving.websplats": b"D4WS", "input/subject.png": b"png"}
STEP = {"step": "fit_gaussians", "digest": "sha256:1", "backend": "cpu", "seed": 3, "weights": {}, "notes": ["a note"]}


def record(files: Files) -> dict[str, Any]:
    return {
        "item": "a fox",
        "profile": "preview",
        "order": "sha256:0",
        "seed": 3,
        "licenses": {},
        "files": files,
        "beside": [VIEWER],
        "steps": [STEP, STEP],
        "run": {"flow_run": "today"},
    }


def finish(folder: Path, files: Files) -> Files:
    (folder / RECORD).write_text(json.dumps(record(files)))
    return files


@pytest.fixture
def package(tmp_path: Path) -> Path:
    with zipfile.ZipFile(tmp_path / "package.zip", "w") as archive:
        for name, content in CONTENT.items():
            archive.writestr(name, content)
    publish(tmp_path / "package.zip", tmp_path / "fox", finish)
    return tmp_path / "fox"


def test_splats_of_the_store_have_a_page_without_a_mesh(tmp_path: Path, package: Path) -> None:
    (tmp_path / "splats").write_bytes(b"D4WS and more")
    page = viewer_of_artifact(tmp_path / "splats", "a <fox>")
    assert "<h1>a &lt;fox&gt;: static splats</h1>" in page
    assert 'id="data-splats"' in page and 'id="data-glb"' not in page
    packed = tmp_path / "package.zip"
    assert viewer_of_artifact(packed, "a fox") == viewer_of_package(packed, "a fox")
    (tmp_path / "text").write_text("D4")
    with pytest.raises(BadInput, match="not a package"):
        viewer_of_artifact(tmp_path / "text", "text")


def test_a_page_that_is_missing_or_altered_is_made(package: Path) -> None:
    page = view(package, open_browser=False)
    assert page == package / VIEWER
    text = page.read_text(encoding="utf-8")
    assert "<h1>a fox</h1>" in text
    page.write_text("something else")
    assert view(package, open_browser=False).read_text(encoding="utf-8") == text


def test_a_page_that_is_right_is_left_alone(package: Path) -> None:
    before = view(package, open_browser=False).stat()
    after = view(package, open_browser=False).stat()
    assert (after.st_ino, after.st_mtime_ns) == (before.st_ino, before.st_mtime_ns)


def test_the_page_does_not_depend_on_the_run(package: Path) -> None:
    known = json.loads((package / RECORD).read_text())
    page = viewer_html(known, CONTENT.__getitem__)
    assert viewer_html(known | {"run": {"flow_run": "tomorrow"}}, CONTENT.__getitem__) == page
    assert viewer_html(known | {"seed": 4}, CONTENT.__getitem__) != page


@pytest.mark.parametrize("signed", [False, True])
def test_looking_at_a_package_does_not_change_it(tmp_path: Path, signed: bool) -> None:
    with identity(tmp_path).configured() if signed else nullcontext():
        folder = made_package(tmp_path)
        view(folder, open_browser=False)
        assert verify(folder).exit_code == 0


def test_every_step_and_every_file_is_among_the_facts(package: Path) -> None:
    facts = viewer_facts(json.loads((package / RECORD).read_text()))
    assert facts["Provenance"]["profile"] == "preview"
    assert list(facts["Steps"]) == ["1. fit_gaussians", "2. fit_gaussians"]
    assert facts["Steps"]["1. fit_gaussians"] == {
        "digest": "sha256:1",
        "backend": "cpu",
        "seed": 3,
        "notes": ["a note"],
    }
    assert set(facts["Files"]) == set(CONTENT)


@pytest.mark.parametrize(
    ("name", "content", "word"),
    [
        ("asset.glb", None, "asset.glb is missing"),
        ("splats/moving.websplats", b"D4WT", "splats/moving.websplats was altered"),
        ("asset.json", b"", "asset.json was altered"),
    ],
)
def test_a_missing_or_altered_file_is_named(package: Path, name: str, content: bytes | None, word: str) -> None:
    (package / name).unlink()
    if content is not None:
        (package / name).write_bytes(content)
    with pytest.raises(BadInput, match=word):
        view(package, open_browser=False)
    assert not (package / VIEWER).exists()


def test_many_faults_are_counted(package: Path) -> None:
    for name in CONTENT:
        (package / name).unlink()
    with pytest.raises(BadInput, match="and 1 more"):
        view(package, open_browser=False)


def test_a_folder_that_is_no_package_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="nowhere does not exist"):
        view(tmp_path / "nowhere", open_browser=False)


def test_a_page_that_cannot_be_written_is_said(package: Path) -> None:
    (package / VIEWER).mkdir()
    with pytest.raises(BadInput, match="cannot be written"):
        view(package, open_browser=False)


@pytest.mark.parametrize(("asked", "display", "shown"), [(True, ":0", 1), (True, "", 0), (False, ":0", 0)])
def test_a_browser_is_opened_where_there_is_a_screen(
    package: Path, monkeypatch: pytest.MonkeyPatch, asked: bool, display: str, shown: int
) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.setattr(module.sys, "platform", "linux")
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    view(package, open_browser=asked)
    assert opened == [(package / VIEWER).resolve().as_uri()] * shown
