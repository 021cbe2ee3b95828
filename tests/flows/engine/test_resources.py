"""What steps share: a GPU has one step at a time, whoever asks; the processor's turns go on meanwhile."""

import errno
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from dg4d_lib.errors import BadInput
from flows.engine import resources
from flows.engine.resources import Resource, Stopped, Turn, resource_of, slot
from flows.engine.turns import first_ahead, ticket
from steps.contract import StepRequest

HOLDER = """
import sys, time
from flows.engine.resources import slot
for _ in range(3):
    with slot("gpu", lambda text: None), open(sys.argv[1], "a") as log:
        log.write("begin\\n"); log.flush(); time.sleep(0.15); log.write("end\\n")
"""


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    monkeypatch.setenv("DG4D_CPUS", "1")
    monkeypatch.delenv("DG4D_GPUS", raising=False)


def silent(text: str) -> None:
    pass


def all_at_once(*work: Callable[[], None]) -> None:
    threads = [threading.Thread(target=one) for one in work]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
        assert not thread.is_alive(), "it waits for ever"


def are_inside(resource: Resource, count: int) -> None:
    """Of twice as many users, exactly so many are inside at a time: they meet there, and there never are more."""
    meeting = threading.Barrier(count, timeout=60)
    inside, most, mutex = 0, 0, threading.Lock()

    def use() -> None:
        nonlocal inside, most
        with slot(resource, silent):
            with mutex:
                inside += 1
                most = max(most, inside)
            meeting.wait()
            time.sleep(0.1)  # time for one too many to come in
            with mutex:
                inside -= 1

    all_at_once(*[use] * (2 * count))
    assert not meeting.broken
    assert most == count


def test_a_gpu_has_one_step_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    are_inside("gpu", 1)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1")
    are_inside("gpu", 2)
    monkeypatch.setenv("DG4D_GPUS", "1")
    are_inside("gpu", 1)


def test_the_processor_has_as_many_turns_as_it_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    are_inside("cpu", 1)
    monkeypatch.setenv("DG4D_CPUS", "3")
    are_inside("cpu", 3)


def test_a_step_on_the_processor_runs_beside_one_on_a_gpu() -> None:
    both_inside = threading.Barrier(2, timeout=60)

    def use(resource: Resource) -> Callable[[], None]:
        def inside() -> None:
            with slot(resource, silent):
                both_inside.wait()

        return inside

    all_at_once(use("gpu"), use("cpu"))
    assert not both_inside.broken


def test_two_commands_share_the_gpus_of_one_user(tmp_path: Path) -> None:
    command = [sys.executable, "-c", HOLDER, str(tmp_path / "log")]
    both = [subprocess.Popen(command) for _ in range(2)]
    assert [one.wait(60) for one in both] == [0, 0]
    assert (tmp_path / "log").read_text().split() == ["begin", "end"] * 6


def test_a_gpu_is_taken_until_the_process_of_its_step_has_ended() -> None:
    with slot("gpu", silent):
        step = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE, pass_fds=resources.handles())
    waited = threading.Event()
    got = threading.Event()

    def next_step() -> None:
        with slot("gpu", lambda text: waited.set()):
            got.set()

    thread = threading.Thread(target=next_step)
    thread.start()
    assert waited.wait(60)
    assert not got.wait(0.3)
    step.kill()
    step.wait()
    assert got.wait(60)
    thread.join()
    assert step.stdin is not None
    step.stdin.close()


def test_steps_on_two_gpus_see_one_each(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "GPU-a1, GPU-b2")
    seen: set[str] = set()
    both_inside = threading.Barrier(2, timeout=60)

    def use() -> None:
        with slot("gpu", silent):
            both_inside.wait()
            seen.add(resources.environment()["CUDA_VISIBLE_DEVICES"])

    all_at_once(use, use)
    assert seen == {"GPU-a1", "GPU-b2"}
    with slot("cpu", silent):
        assert resources.environment() == {}
    assert (resources.environment(), resources.handles()) == ({}, ())


@pytest.mark.parametrize(
    ("step", "settings", "weights", "needs"),
    [
        ("fit_gaussians", {"rasterizer": "cuda_gsplat"}, {}, "gpu"),
        ("fit_gaussians", {"rasterizer": "cpu"}, {}, "cpu"),
        ("fit_gaussians", {"rasterizer": "cpu"}, {"zero123-xl": "sha256:" + "1" * 64}, "gpu"),
        ("fit_motion", {"rasterizer": "cuda_gsplat"}, {}, "gpu"),
        ("drive_video", {}, {"svd": "sha256:" + "1" * 64}, "gpu"),
        ("drive_video", {}, {}, "cpu"),
        ("extract_mesh", {"rasterizer": "cuda_gsplat"}, {}, "cpu"),
        ("pack_asset", {"rasterizer": "cuda_gsplat"}, {}, "cpu"),
    ],
)
def test_only_steps_that_fill_a_gpu_wait_for_one(
    step: str, settings: dict[str, str], weights: dict[str, str], needs: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    request = StepRequest(step=step, version="1", inputs={}, settings=settings, seed=0, weights=weights)
    assert resource_of(request) == needs
    monkeypatch.setenv("DG4D_GPUS", "0")
    assert resource_of(request) == "cpu"


@pytest.mark.parametrize(("name", "value"), [("DG4D_GPUS", "all"), ("DG4D_GPUS", "-1"), ("DG4D_CPUS", "0")])
def test_a_number_that_is_none_is_refused(name: str, value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(name, value)
    with pytest.raises(BadInput, match=name):
        resources.gpus(), resources.cpus()


def test_few_cores_take_one_step_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DG4D_CPUS")
    for cores, steps in ((1, 1), (2, 1), (4, 1), (16, 4)):
        monkeypatch.setattr(resources.os, "sched_getaffinity", lambda pid, cores=cores: set(range(cores)))
        assert resources.cpus() == steps


def test_a_step_that_waits_ends_when_the_user_stops_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    stopping = threading.Event()
    monkeypatch.setattr(resources, "stopping", stopping)
    told: list[str] = []

    def stop(text: str) -> None:
        told.append(text)
        stopping.set()

    fit = Turn(1, "fit_motion of newt")
    with slot("gpu", silent, fit), pytest.raises(Stopped), slot("gpu", stop):
        pass
    assert told == ["waiting for a GPU, behind fit_motion of newt"]


def test_turns_are_taken_in_the_order_in_which_items_were_begun_and_then_of_asking(tmp_path: Path) -> None:
    served: list[str] = []
    told: list[str] = []

    def use(begun_ns: int, name: str) -> threading.Thread:
        asked = threading.Event()

        def work() -> None:
            def waiting(text: str) -> None:
                told.append(text)
                asked.set()

            with slot("cpu", waiting, Turn(begun_ns, name)) as waited_s:
                served.append(name)
                assert waited_s > 0.1

        thread = threading.Thread(target=work)
        thread.start()
        assert asked.wait(60)
        return thread

    with slot("cpu", silent, Turn(9, "the one at work")):
        waiting = [use(begun_ns, name) for begun_ns, name in ((5, "b1"), (7, "c"), (5, "b2"), (3, "a"))]
        time.sleep(0.2)
    for thread in waiting:
        thread.join(60)
    assert served == ["a", "b1", "b2", "c"]
    assert told[0].endswith("behind the one at work") and told[1].endswith("behind b1")
    assert list((tmp_path / "home" / "slots" / "queue-cpu").iterdir()) == []


def test_who_waited_and_was_killed_holds_up_nobody(tmp_path: Path) -> None:
    waits = "import sys; from flows.engine.resources import *; print(flush=True)\n"
    waits += "with slot('cpu', lambda text: print(text, flush=True), Turn(1, 'killed')): pass"
    with slot("cpu", silent):
        killed = subprocess.Popen([sys.executable, "-c", waits], stdout=subprocess.PIPE, text=True)
        assert killed.stdout is not None
        killed.stdout.readline(), killed.stdout.readline()  # it stands in the queue
        killed.kill()
        killed.wait()
        killed.stdout.close()
    with slot("cpu", silent) as waited_s:
        assert waited_s < 5


def test_a_slot_names_nobody_when_its_step_has_ended(tmp_path: Path) -> None:
    file = tmp_path / "home" / "slots" / "cpu-0.lock"
    with slot("cpu", silent, Turn(1, "fit_motion of a newt")):
        assert file.read_text() == "fit_motion of a newt"
    assert file.read_text() == ""


def test_a_full_disk_keeps_no_slot_and_no_ticket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as disk:
        disk.setattr(os, "pwrite", full)
        with slot("cpu", silent):  # its name is worth no failed step
            pass
    with monkeypatch.context() as disk:
        disk.setattr(Path, "write_text", full)
        with pytest.raises(OSError, match="No space"), slot("cpu", silent):
            pass
    assert list((tmp_path / "home" / "slots" / "queue-cpu").iterdir()) == []
    with slot("cpu", silent) as waited_s:
        assert waited_s < 5


def test_a_ticket_without_a_name_is_ahead_as_well(tmp_path: Path) -> None:
    with ticket(tmp_path, 1, "") as first, ticket(tmp_path, 2, "second") as second, ticket(tmp_path, 3, "") as third:
        assert first_ahead(first) is None
        assert first_ahead(second) == first_ahead(third) == first.stem
    assert list(tmp_path.iterdir()) == []


def test_slots_and_queues_are_in_the_folder_that_the_variable_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with slot("gpu", silent):  # of another pod, whose home folder is the same
        monkeypatch.setenv("DG4D_SLOTS", str(tmp_path / "pod" / "slots"))
        with slot("gpu", silent) as waited_s:
            assert waited_s < 5
            names = {path.name for path in (tmp_path / "pod" / "slots").iterdir()}
    assert names == {"gpu-0.lock", "queue-gpu"}


@pytest.mark.parametrize(("name", "says"), [("file", "File exists"), ("file/slots", "Not a directory")])
def test_slots_where_no_folder_can_be_are_refused(
    name: str, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("DG4D_SLOTS", str(tmp_path / name))
    with pytest.raises(BadInput, match=rf"\$DG4D_SLOTS is .*{says}; set it to a folder"), slot("cpu", silent):
        pass


def test_a_full_disk_is_not_called_a_wrong_folder_of_slots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, **_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setenv("DG4D_SLOTS", str(tmp_path / "slots"))
    monkeypatch.setattr(Path, "mkdir", full)
    with pytest.raises(OSError, match="No space"), slot("cpu", silent):
        pass


def test_a_wait_is_reported_once(monkeypatch: pytest.MonkeyPatch) -> None:
    held, free, reports, attempts = threading.Event(), threading.Event(), [], []

    def hold() -> None:
        with slot("cpu", silent):
            held.set()
            free.wait(60)

    def counted(own: Path) -> str | None:
        attempts.append(own)
        if len(attempts) == 5:
            free.set()
        return first_ahead(own)

    def wait() -> None:
        held.wait(60)
        monkeypatch.setattr(resources, "first_ahead", counted)
        with slot("cpu", reports.append):
            pass

    all_at_once(hold, wait)
    assert len(attempts) >= 5 and len(reports) == 1


def test_slots_in_a_folder_of_somebody_else_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_SLOTS", str(tmp_path))
    monkeypatch.setattr(os, "access", lambda path, mode: path != tmp_path)  # the tests may run as root
    with pytest.raises(BadInput, match=r"\$DG4D_SLOTS is .*no permission"), slot("cpu", silent):
        pass


def test_a_relative_folder_of_slots_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_SLOTS", "slots")
    with pytest.raises(BadInput, match="'slots'; set it to an absolute path"), slot("cpu", silent):
        pass
