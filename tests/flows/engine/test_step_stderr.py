"""The last lines of a step's standard error explain how its process died."""

from pathlib import Path

import pytest

from flows.engine.executors import StepCrashed, in_subprocess
from steps.contract import StepRequest, StepSpec

DYING = """
import ctypes, os, sys
from steps.contract import Port, StepSpec
spec = dict(version="1", settings="dg4d_lib.settings:Settings", inputs={}, outputs={}, timeout_s=60)
STEPS = {name: StepSpec(name=name, entry=f"dying:{name}", **spec) for name in ("exits", "segfaults", "aborts")}
STEPS["broken"] = StepSpec(name="broken", entry="broken:run", **spec)

def exits(job):
    print("the license server refused", file=sys.stderr)
    os._exit(7)

def aborts(job):
    print("the driver is too old", file=sys.stderr)
    deep(20)

def deep(frames):
    deep(frames - 1) if frames else os.abort()

def segfaults(job):
    ctypes.string_at(0)
"""


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "dying.py").write_text(DYING)
    (tmp_path / "broken.py").write_text('raise ImportError("libfoo.so.3 is missing")')
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path / 'first'}:{tmp_path}")
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("DG4D_CATALOG", "dying:STEPS")
    monkeypatch.setenv("DG4D_CODE_VERSION", "test")
    return tmp_path


def message_of(name: str) -> str:
    spec = StepSpec(
        name=name, version="1", entry="dying:run", settings="dg4d_lib.settings:Settings", inputs={}, outputs={}
    )
    request = StepRequest(step=name, version="1", inputs={}, settings={}, seed=0)
    with pytest.raises(StepCrashed) as caught:
        in_subprocess(spec, request, lambda *_: None, lambda _: None)
    return caught.value.message


@pytest.mark.parametrize(
    ("name", "lines"),
    [
        ("exits", ["exited with status 7", "the license server refused"]),
        ("segfaults", ["killed by signal 11", "Segmentation fault", "in segfaults"]),
        ("aborts", ["killed by signal 6", "the driver is too old"]),
        ("broken", ["libfoo.so.3 is missing"]),
    ],
)
def test_the_message_of_a_step_that_died_shows_its_last_words(name: str, lines: list[str]) -> None:
    message = message_of(name)
    assert [line for line in lines if line not in message] == []


def test_the_message_of_a_program_that_cannot_be_imported_shows_why(place: Path) -> None:
    (place / "first").mkdir()
    (place / "first" / "pydantic.py").write_text('raise ImportError("libpydantic.so: cannot open shared object file")')
    message = message_of("exits")
    assert "exited with status 1" in message
    assert "libpydantic.so: cannot open shared object file" in message
