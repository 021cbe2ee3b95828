import os
import signal
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import fake_steps
import pytest
from waiting import wait_until

from flows.engine import forks
from flows.engine.executors import in_subprocess
from flows.engine.forks import Fork, ForkServer
from flows.step_errors import StepOutOfMemory
from steps.contract import StepRequest
from steps.profiles import PREVIEW, step_settings
from steps.runtime.installed_code import request_version
from steps.store.artifact_store import ArtifactStore

SETTINGS = step_settings("prepare_subject", PREVIEW).model_dump(mode="json")


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("DG4D_STORE", str(tmp_path / "store"))
    monkeypatch.setenv("DG4D_CATALOG", "fake_steps:STEPS")
    monkeypatch.setenv("DG4D_CODE_VERSION", "test")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))
    monkeypatch.setenv("FAKE_LOG", str(tmp_path / "log"))
    return tmp_path


@pytest.fixture(autouse=True)
def begun() -> Iterator[list[Fork]]:
    """What a test has begun; its pipes are closed when the test ends."""
    processes: list[Fork] = []
    yield processes
    for process in processes:
        process.stdout.close()


@pytest.fixture
def server() -> Iterator[ForkServer]:
    server = ForkServer(dict(os.environ))
    yield server
    server.end()


def begin(server: ForkServer, begun: list[Fork], place: Path, words: str) -> Fork:
    (place / f"{words}.json").write_text(_request(place, words).model_dump_json())
    with (place / "stderr").open("ab") as stderr:
        process = server.fork([str(place / f"{words}.json"), str(place / f"{words}.out")], {}, stderr, [])
    assert process is not None
    begun.append(process)
    return process


def test_steps_run_side_by_side_and_each_has_its_own_status(place: Path, server: ForkServer, begun: list[Fork]) -> None:
    words = ["prepare_subject=sleep:1.5", "fine", "prepare_subject=bad:torn", "prepare_subject=die"]
    slow, *quick = [begin(server, begun, place, text) for text in words]
    assert [process.wait(60) for process in quick] == [0, 65, -signal.SIGKILL]
    assert slow.poll() is None
    assert slow.wait(60) == 0 and slow.poll() == 0
    assert (place / "prepare_subject=sleep:1.5.out").exists()


def test_a_step_is_a_process_group_of_its_own(place: Path, server: ForkServer, begun: list[Fork]) -> None:
    one, other = (begin(server, begun, place, f"prepare_subject=sleep:{30 + number}") for number in range(2))
    os.killpg(one.pid, signal.SIGKILL)
    assert one.wait(60) == -signal.SIGKILL
    time.sleep(0.1)
    assert other.poll() is None


def test_steps_end_with_their_server_and_the_server_begins_no_more(
    place: Path, server: ForkServer, begun: list[Fork]
) -> None:
    process = begin(server, begun, place, "prepare_subject=sleep:30")
    server.end()
    assert process.wait(60) == -signal.SIGKILL
    wait_until(lambda: not Path(f"/proc/{process.pid}/stat").exists())
    with (place / "stderr").open("ab") as stderr:
        assert server.fork([], {}, stderr, []) is None


def test_a_step_holds_what_it_is_given_and_prints_where_it_is_told(
    place: Path, server: ForkServer, begun: list[Fork]
) -> None:
    reading, writing = os.pipe()
    (place / "wrong.json").write_text("{}")
    with (place / "stderr").open("wb") as stderr:
        process = server.fork(
            [str(place / "wrong.json"), str(place / "out")], {"TMPDIR": str(place)}, stderr, [writing]
        )
    assert process is not None
    begun.append(process)
    os.close(writing)
    assert os.read(reading, 1) == b""  # the pipe ends when the last process that holds it has ended
    os.close(reading)
    assert process.wait(60) == 65
    assert "is not a StepRequest" in (place / "stderr").read_text()
    assert process.stdout.read() == ""


def test_the_next_step_is_a_fork_of_the_same_process_and_one_for_another_environment_is_not(
    place: Path, begun: list[Fork], monkeypatch: pytest.MonkeyPatch
) -> None:
    def parent() -> int:
        for _ in range(50):
            with (place / "stderr").open("ab") as stderr:
                process = forks.fork([], {}, stderr, [])
            assert process is not None
            begun.append(process)
            number = None
            with suppress(OSError):  # a step without arguments ends at once, at times before it is looked at
                number = int(Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[1])
            process.wait(60)
            if number is not None:
                return number
        raise AssertionError("no process was seen")

    forks.prepare()
    first = parent()
    assert first == forks._server().process.pid
    monkeypatch.setenv("OpenImageIO_ROOT", "as that library sets it when it is imported")
    assert parent() == first
    monkeypatch.setenv("DG4D_STORE", str(place / "elsewhere"))
    assert parent() != first
    while begun:
        begun.pop().stdout.close()
    wait_until(lambda: not Path(f"/proc/{first}/stat").exists())


def test_a_step_goes_on_when_the_environment_changes_and_its_server_ends_with_it(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = fake_steps.STEPS["prepare_subject"]
    server = forks._server().process
    with ThreadPoolExecutor(1) as side:
        step = side.submit(
            in_subprocess, spec, _request(place, "prepare_subject=sleep:1"), lambda *_: None, lambda _: None
        )
        wait_until((place / "log").exists)
        monkeypatch.setenv("DG4D_STORE", str(place / "elsewhere"))
        assert forks._server().process is not server
        assert server.poll() is None
        assert step.result(60).outputs
    del step
    wait_until(lambda: server.poll() is not None)


def test_a_server_that_was_killed_is_followed_by_another(place: Path) -> None:
    spec = fake_steps.STEPS["prepare_subject"]

    def run(words: str) -> None:
        in_subprocess(spec, _request(place, words), lambda *_: None, lambda _: None)

    run("fine")
    forks._server().process.kill()
    run("fine too")
    dying = forks._server()
    dying._control.close()  # as of a process that has closed its descriptors and is not a zombie yet
    run("fine as well")
    assert dying.process.poll() is not None
    killed = forks._server().process
    with pytest.raises(StepOutOfMemory):
        run(f"prepare_subject=kill:{killed.pid}")


def _request(place: Path, words: str) -> StepRequest:
    spec = fake_steps.STEPS["prepare_subject"]
    source = ArtifactStore(place / "store").put_bytes(words.encode(), "application/octet-stream")
    return StepRequest(
        step=spec.name, version=request_version(spec), inputs={"source": source}, settings=SETTINGS, seed=0
    )
