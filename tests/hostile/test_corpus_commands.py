"""A handful of the corpus through the real command, in a process of its own, as a user meets it."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from hashlib import sha256
from pathlib import Path

import pytest

from tests.hostile.archives import ZIPS
from tests.hostile.conftest import Place
from tests.hostile.documents import RECORDS, SCENES
from tests.hostile.manifests import ROWS
from tests.hostile.options import DEEP
from tests.hostile.others import OTHERS, PLACES
from tests.hostile.pictures import PICTURES
from tests.hostile.videos import VIDEOS

Prepare = Callable[[Path], object]
COMMANDS: dict[str, tuple[Prepare, list[bytes], str]] = {
    "command: a document called PNG": (
        lambda work: (work / "cat.png").write_bytes(OTHERS["other: PDF and zip"]()),
        [b"make", b"cat.png"],
        "not known here|not a picture",
    ),
    "command: a device": (
        lambda work: PLACES["place: a device"](work / "tape.png"),
        [b"make", b"tape.png"],
        "not a regular file",
    ),
    "command: a name that is not UTF-8": (
        lambda work: _named(work, b"caf\xe9.png"),
        [b"make", b"caf\xe9.png"],
        "UTF-8",
    ),
    "command: a name of 251 letters": (
        lambda work: _named(work, b"a" * 251 + b".png"),
        [b"make", b"a" * 251 + b".png"],
        "long|characters|bytes",
    ),
    "command: brackets without end": (
        lambda work: None,
        [b"make", b"cat.png", b"--set", f"mesh.grid={DEEP}".encode()],
        "mesh.grid|nested|deep",
    ),
    "command: a seed of 23 digits": (
        lambda work: None,
        [b"make", b"cat.png", b"--seed", b"9" * 23],
        "seed",
    ),
    "command: a manifest whose one row is bad": (
        lambda work: (work / "m.json").write_text(json.dumps([{"path": "../cat.png"}])),
        [b"batch", b"m.json", b"-o", b"."],
        "leads out",
    ),
    "command: a nested record": (
        lambda work: (work / "provenance.json").write_bytes(RECORDS["record: braces without end"]()),
        [b"verify", b"."],
        "not an asset",
    ),
    "command: a nested scene": (
        lambda work: (work / "scene.json").write_bytes(SCENES["scene: braces without end"]()),
        [b"compose", b"--scene", b"scene.json", b"-o", b"scene.glb"],
        "JSON",
    ),
}  # fmt: skip
SUMMARY = {"summary.json", "summary.csv", "index.html"}

# refused only by the step that decodes
IN_THE_STEP = {
    "cut.png": PICTURES["png: cut at a half"],
    "short.webp": PICTURES["webp: 17 bytes"],
    "nothing.png": PICTURES["png: nothing visible"],
    "garbage.zip.png": ZIPS["zip: deflate garbage"],
    "one.mp4": VIDEOS["mp4: one frame"],
    "sound.mp4": VIDEOS["mp4: sound alone"],
}


def _named(work: Path, name: bytes) -> None:
    with open(os.fsencode(work) + b"/" + name, "wb") as file:  # noqa: PTH123  # a name of bytes
        file.write(PICTURES["png: 1 bit"]())


def run(place: Place, *arguments: bytes | str) -> tuple[int, str]:
    """Run the command; its status, and all that it prints. A server that it starts would keep a pipe open."""
    told = place.home.with_name("told.txt")
    with told.open("wb") as file:
        done = subprocess.run(
            [sys.executable, "-m", "flows.cli", *arguments], stdout=file, stderr=file, check=False, timeout=300
        )
    return done.returncode, told.read_text(errors="replace")


@pytest.fixture
def offline(place: Place, monkeypatch: pytest.MonkeyPatch) -> Place:
    """Name a server that does not answer: what begins against all expectation ends at once."""
    monkeypatch.setenv("PREFECT_API_URL", "http://127.0.0.1:9/api")
    return place


@pytest.mark.parametrize("name", COMMANDS)
def test_the_command_refuses_in_a_sentence_and_leaves_nothing(name: str, offline: Place) -> None:
    place = offline
    prepare, arguments, says = COMMANDS[name]
    (place.work / "cat.png").write_bytes(PICTURES["png: 1 bit"]())
    prepare(place.work)
    before = sorted(os.fsencode(path) for path in place.work.rglob("*"))
    status, told = run(place, *arguments)
    assert status in (2, 65), told
    assert re.search(says, told), told
    assert "Traceback" not in told
    after = {os.fsencode(path) for path in place.work.rglob("*")} - {os.fsencode(place.work / one) for one in SUMMARY}
    assert sorted(after) == before
    assert place.stored() == []


@pytest.fixture
def server_ends(place: Place) -> Iterator[None]:
    yield
    assert run(place, "down")[0] == 0


@pytest.mark.slow
def test_a_real_batch_of_files_that_cannot_be_decoded(place: Place, server_ends: None) -> None:
    for name, make in IN_THE_STEP.items():
        (place.work / "in" / name).parent.mkdir(exist_ok=True)
        (place.work / "in" / name).write_bytes(make())
    status, told = run(place, "batch", "in", "-o", "out")
    assert status == 65, told
    assert "Traceback" not in told
    rows = json.loads((place.work / "out" / "summary.json").read_text())["items"]
    assert len(rows) == len(IN_THE_STEP)
    assert {row["status"] for row in rows} == {"failed"}
    assert {row["kind"] for row in rows} <= {"BadInput", "StepBadInput"}, rows
    assert {path.name for path in (place.work / "out").iterdir()} == SUMMARY
    blobs = {sha256(make()).hexdigest() for make in IN_THE_STEP.values()}
    assert run(place, "store", "gc", "--grace-hours", "0")[0] == 0
    assert not {path.name for path in (place.home / "store").rglob("*")} & blobs


def test_a_manifest_of_every_bad_row_ends_with_a_summary_of_all(offline: Place) -> None:
    place = offline
    rows = [json.loads(make().decode())[0] for suffix, make in ROWS.values() if suffix == ".json"]
    (place.work / "cat.png").write_bytes(PICTURES["png: 1 bit"]())
    (place.work / "m.json").write_text(json.dumps(rows))
    status, told = run(place, "batch", "m.json", "-o", "out")
    assert status == 65, told[-2000:]
    assert "Traceback" not in told
    summary = json.loads((place.work / "out" / "summary.json").read_text())["items"]
    assert len(summary) == len(rows)
    assert {row["status"] for row in summary} == {"failed"}
    assert place.stored() == []
