import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import fake_steps
import pytest
import stand_in_engine

from flows.engine.containers import container
from flows.engine.executors import Execute, configured_executor, in_container, in_process, in_subprocess
from flows.step_errors import (
    StepBadInput,
    StepCrashed,
    StepDiverged,
    StepError,
    StepMissing,
    StepOutOfMemory,
    StepTimedOut,
)
from steps.contract import StepRequest, StepSpec
from steps.profiles import PREVIEW, step_settings
from steps.runtime.installed_code import request_version
from steps.store.artifact_store import ArtifactStore

HERE = str(Path(__file__).parents[1])
OUTSIDE = [in_subprocess, in_container]

SETTINGS = step_settings("prepare_subject", PREVIEW).model_dump(mode="json")


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("DG4D_CATALOG", "fake_steps:STEPS")
    monkeypatch.setenv("DG4D_CODE_VERSION", "test")
    monkeypatch.setenv("PYTHONPATH", HERE)
    monkeypatch.setenv("FAKE_LOG", str(tmp_path / "log"))
    monkeypatch.setenv("DG4D_ENGINE", str(stand_in_engine.install(tmp_path)))
    return tmp_path


def ask(place: Path, words: str) -> tuple[StepSpec, StepRequest]:
    spec = fake_steps.STEPS["prepare_subject"]
    source = ArtifactStore(place / "home" / "store").put_bytes(words.encode(), "application/octet-stream")
    return spec, StepRequest(
        step=spec.name, version=request_version(spec), inputs={"source": source}, settings=SETTINGS, seed=0
    )


def ignore(*_: object) -> None:
    pass


@pytest.mark.parametrize("execute", OUTSIDE)
def test_a_process_or_container_gives_the_same_digests_as_this_process(place: Path, execute: Execute) -> None:
    spec, request = ask(place, "hello moving")
    here, there = in_process(spec, request, ignore, ignore), execute(spec, request, ignore, ignore)
    assert here.outputs == there.outputs
    assert here.provenance.digest() == there.provenance.digest()


def test_code_in_the_current_folder_is_not_run(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    foreign = place / "pictures"
    for module in ("steps/__init__.py", "random.py", "dg4d_lib/__init__.py", "sitecustomize.py"):
        (foreign / module).parent.mkdir(parents=True, exist_ok=True)
        (foreign / module).write_text(f"open({str(place / 'run')!r}, 'a').write(__name__)\nraise ImportError")
    monkeypatch.chdir(foreign)
    monkeypatch.setenv("DG4D_CODE_VERSION", "foreign folder")  # another environment, so another process of steps
    spec, request = ask(place, "hello")
    assert in_subprocess(spec, request, ignore, ignore).outputs
    assert not (place / "run").exists()


@pytest.mark.parametrize("execute", [in_process, *OUTSIDE])
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
@pytest.mark.parametrize("execute", OUTSIDE)
def test_all_executors_raise_the_same_error(place: Path, word: str, error: type[StepError], execute: Execute) -> None:
    spec, request = ask(place, f"prepare_subject={word}")
    with pytest.raises(error) as here:
        in_process(spec, request, ignore, ignore)
    with pytest.raises(error) as there:
        execute(spec, request, ignore, ignore)
    assert here.value.message == there.value.message
    assert here.value.pictures == there.value.pictures
    assert bool(here.value.pictures) == (error is StepDiverged)


@pytest.mark.parametrize("execute", OUTSIDE)
def test_a_step_that_is_killed_from_outside_ran_out_of_memory(place: Path, execute: Execute) -> None:
    with pytest.raises(StepOutOfMemory, match="memory"):
        execute(*ask(place, "prepare_subject=die"), ignore, ignore)


@pytest.mark.parametrize("execute", OUTSIDE)
def test_a_step_that_takes_too_long_is_stopped(place: Path, execute: Execute) -> None:
    spec, request = ask(place, "prepare_subject=sleep:60")
    start = time.monotonic()
    with pytest.raises(StepTimedOut, match=r"no result after 1\.5 s"):
        execute(spec.model_copy(update={"timeout_s": 1.5}), request, ignore, ignore)
    assert time.monotonic() - start < 50
    assert _steps_of(place) == []
    assert list((place / "home" / "scratch").iterdir()) == []


@pytest.mark.parametrize("execute", OUTSIDE)
def test_a_step_is_killed_when_the_command_is(place: Path, execute: Execute) -> None:
    parent = _command(place, execute, "prepare_subject=sleep:60")
    _wait_for(place / "log")
    (child,) = _steps_of(place)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    deadline = time.monotonic() + 60
    while child in _processes() and time.monotonic() < deadline:
        time.sleep(0.02)
    assert child not in _processes()
    in_subprocess(*ask(place, "fine"), ignore, ignore)  # the next command clears up
    assert list((place / "home" / "scratch").iterdir()) == []


def test_a_step_of_a_command_in_another_container_keeps_its_files(place: Path) -> None:
    own_processes = ["unshare", "--pid", "--fork", "--kill-child"]
    if subprocess.run([*own_processes, "true"], capture_output=True, check=False).returncode:
        pytest.skip("a process cannot have processes of its own here (it takes root)")
    sleeping = _command(place, in_subprocess, "prepare_subject=sleep:60")
    try:
        _wait_for(place / "log")
        folders = list((place / "home" / "scratch").iterdir())
        assert _command(place, in_subprocess, "fine", *own_processes).wait() == 0
        assert len(folders) == 1 and list((place / "home" / "scratch").iterdir()) == folders
    finally:
        sleeping.kill()
        sleeping.wait()


def test_a_container_sees_its_own_files_and_no_network_and_no_secret(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("AWS_SECRET_ACCESS_KEY", "HF_TOKEN", "DG4D_SIGNING_KEY"):
        monkeypatch.setenv(name, "a secret")
    monkeypatch.setenv("DG4D_MEMORY", "2g")
    in_container(*ask(place, "hello"), ignore, ignore)
    (words,) = (words for words in stand_in_engine.asked(place) if words[0] == "run")
    home = place / "home"
    folders = [Path(word.split("target=")[1]) for word in words if word.startswith("type=bind")]
    assert [folder.relative_to(home).parts[0] for folder in folders] == ["scratch", "kernels", "store"]
    said = " ".join(words)
    assert "--network none --" in said and "--read-only" in said and "--cap-drop all" in said and "--memory 2g" in said
    assert "a secret" not in said
    assert [word for word in words if "AWS_" in word or "TOKEN" in word or "SIGNING" in word] == []


def test_the_keys_of_a_bucket_are_handed_over_by_name_only(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "a secret")
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9000")
    _, request = ask(place, "hello")
    words = container(request, tmp_path, "s3://bucket/prefix").command
    assert "AWS_SECRET_ACCESS_KEY" in words and "a secret" not in " ".join(words)
    assert words[words.index("--network") + 1] == "host"  # the store is on this machine


def test_the_record_names_the_image(place: Path) -> None:
    done = in_container(*ask(place, "hello"), ignore, ignore)
    assert done.provenance.machine["image"] == f"dg4d/cpu@sha256:{stand_in_engine.CONTENT}"


def test_an_image_that_is_not_here_is_named(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_IMAGE_CPU", "registry.example/other:1")
    with pytest.raises(StepMissing, match=r"registry\.example/other:1.*containers\.sh"):
        in_container(*ask(place, "hello"), ignore, ignore)


def test_an_engine_that_is_not_here_is_refused(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_ENGINE", "/nowhere/podman")
    with pytest.raises(StepMissing, match="docker or podman"):
        in_container(*ask(place, "hello"), ignore, ignore)


def test_an_executor_that_does_not_exist_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_EXECUTOR", "rocket")
    with pytest.raises(StepMissing, match="subprocess, container, in_process"):
        configured_executor()


def _processes() -> list[int]:
    return [int(place.name) for place in Path("/proc").iterdir() if place.name.isdigit() and _alive(int(place.name))]


def _command(place: Path, execute: Execute, words: str, *before: str) -> "subprocess.Popen[bytes]":
    """A process of its own that does a step."""
    spec, request = ask(place, words)
    program = f"""
        from fake_steps import STEPS
        from flows.engine.executors import {execute.__name__}
        from steps.contract import StepRequest
        request = StepRequest.model_validate_json({request.model_dump_json()!r})
        {execute.__name__}(STEPS[{spec.name!r}], request, lambda *_: None, lambda _: None)
    """
    return subprocess.Popen([*before, sys.executable, "-c", textwrap.dedent(program)])


def _wait_for(path: Path) -> None:
    deadline = time.monotonic() + 60
    while not path.exists() and time.monotonic() < deadline:
        time.sleep(0.02)


def _steps_of(place: Path) -> list[int]:
    """The processes that do a step of the test whose folder this is."""
    return [pid for pid in _processes() if _read(pid, "comm") == "dg4d prepare_su" and _is_of(pid, place)]


def _is_of(pid: int, place: Path) -> bool:
    return str(place) in _read(pid, "environ") or str(place) in _read(pid, "cmdline")


def _read(pid: int, name: str) -> str:
    try:
        return Path(f"/proc/{pid}/{name}").read_text(errors="replace").strip()
    except OSError:
        return ""


def _alive(pid: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
