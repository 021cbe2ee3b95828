import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import fake_steps
import pytest

from flows.executors import (
    Execute,
    StepBadInput,
    StepCrashed,
    StepDiverged,
    StepError,
    StepMissing,
    StepOutOfMemory,
    StepTimedOut,
    chosen,
    in_process,
    in_subprocess,
)
from steps.contract import StepRequest, StepSpec
from steps.main import request_version
from steps.store import ArtifactStore

HERE = str(Path(__file__).parent)


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("DG4D_CATALOG", "fake_steps:STEPS")
    monkeypatch.setenv("DG4D_CODE_VERSION", "test")
    monkeypatch.setenv("PYTHONPATH", HERE)
    monkeypatch.setenv("FAKE_LOG", str(tmp_path / "log"))
    return tmp_path


def ask(place: Path, words: str) -> tuple[StepSpec, StepRequest]:
    spec = fake_steps.STEPS["prepare_subject"]
    source = ArtifactStore(place / "home" / "store").put_bytes(words.encode(), "application/octet-stream")
    return spec, StepRequest(
        step=spec.name, version=request_version(spec), inputs={"source": source}, settings={}, seed=0
    )


def ignore(done: int, total: int, values: dict[str, float]) -> None:
    pass


def test_a_process_of_its_own_gives_the_same_digests_as_this_one(place: Path) -> None:
    spec, request = ask(place, "hello moving")
    here, there = in_process(spec, request, ignore), in_subprocess(spec, request, ignore)
    assert here.outputs == there.outputs
    assert here.provenance.digest() == there.provenance.digest()


@pytest.mark.parametrize("execute", [in_process, in_subprocess])
def test_what_the_library_logs_is_handed_on(place: Path, execute: Execute) -> None:
    said: list[str] = []
    execute(*ask(place, "prepare_subject=log:compiling"), ignore, said.append)
    assert said == ["compiling"]


@pytest.mark.parametrize(
    ("word", "error"),
    [
        ("bad:ugly", StepBadInput),
        ("missing", StepMissing),
        ("diverge", StepDiverged),
        ("memory", StepOutOfMemory),
        ("crash", StepCrashed),
    ],
)
def test_both_executors_raise_the_same_error(place: Path, word: str, error: type[StepError]) -> None:
    spec, request = ask(place, f"prepare_subject={word}")
    with pytest.raises(error) as here:
        in_process(spec, request, ignore)
    with pytest.raises(error) as there:
        in_subprocess(spec, request, ignore)
    assert here.value.message == there.value.message
    assert here.value.pictures == there.value.pictures
    assert bool(here.value.pictures) == (error is StepDiverged)


def test_a_step_that_is_killed_from_outside_ran_out_of_memory(place: Path) -> None:
    with pytest.raises(StepOutOfMemory, match="memory"):
        in_subprocess(*ask(place, "prepare_subject=die"), ignore)


def test_a_step_that_takes_too_long_is_stopped(place: Path) -> None:
    spec, request = ask(place, "prepare_subject=sleep:60")
    start = time.monotonic()
    with pytest.raises(StepTimedOut, match=r"no result after 1\.5 s"):
        in_subprocess(spec.model_copy(update={"timeout_s": 1.5}), request, ignore)
    assert time.monotonic() - start < 20
    assert list((place / "home" / "scratch").iterdir()) == []


def test_a_step_is_killed_when_the_command_is(place: Path) -> None:
    spec, request = ask(place, "prepare_subject=sleep:60")
    program = f"""
        from fake_steps import STEPS
        from flows.executors import in_subprocess
        from steps.contract import StepRequest
        request = StepRequest.model_validate_json({request.model_dump_json()!r})
        in_subprocess(STEPS[{spec.name!r}], request, lambda *_: None)
    """
    parent = subprocess.Popen([sys.executable, "-c", textwrap.dedent(program)])
    log = place / "log"
    deadline = time.monotonic() + 30
    while not log.exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    (child,) = (int(p.name) for p in Path("/proc").iterdir() if p.name.isdigit() and _parent_of(p) == parent.pid)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    while _alive(child) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not _alive(child)
    in_subprocess(*ask(place, "fine"), ignore)  # the next command clears up
    assert list((place / "home" / "scratch").iterdir()) == []


def test_an_executor_that_does_not_exist_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_EXECUTOR", "rocket")
    with pytest.raises(StepMissing, match="subprocess, in_process"):
        chosen()


def _parent_of(process: Path) -> int:
    try:
        return int((process / "stat").read_text().rpartition(")")[2].split()[1])
    except OSError:
        return 0


def _alive(pid: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
