import errno
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from records import result_with, write_record

from flows.engine.caching import RequestPolicy
from flows.engine.file_locks import FileLocks
from flows.engine.records import record_key, recorded
from steps.contract import ArtifactRef, StepRequest, StepResult
from steps.store.artifact_store import ArtifactStore


def request(**changes: Any) -> StepRequest:
    ref = ArtifactRef(digest="sha256:" + "1" * 64, media_type="a/b", size_bytes=1)
    fields = {"step": "s", "version": "1", "inputs": {"x": ref}, "settings": {"a": 1, "b": 2.0}, "seed": 0}
    return StepRequest(**{**fields, **changes})


def key(policy: RequestPolicy, wanted: StepRequest) -> str | None:
    context: Any = SimpleNamespace(task=SimpleNamespace(name="s"))
    return policy.compute_key(context, {"request": wanted}, {})


def given(_step: str, arguments: Mapping[str, Any]) -> StepRequest:
    wanted: StepRequest = arguments["request"]
    return wanted


def result(store: ArtifactStore) -> StepResult:
    return result_with(store.put_bytes(b"content", "a/b"), request().digest())


def test_the_key_follows_everything_a_step_depends_on_and_nothing_else() -> None:
    policy = RequestPolicy(request_for=given)
    other = ArtifactRef(digest="sha256:" + "2" * 64, media_type="a/b", size_bytes=1)
    different = [
        request(step="t"),
        request(version="2"),
        request(inputs={"y": request().inputs["x"]}),
        request(inputs={"x": other}),
        request(settings={"a": 1, "b": 2.5}),
        request(settings={"a": True, "b": 2.0}),
        request(seed=1),
    ]
    keys = {key(policy, r) for r in [request(), *different]}
    assert len(keys) == 1 + len(different)
    assert key(policy, request(settings={"b": 2.0, "a": 1})) in keys
    assert key(policy, request()) == record_key(request())


@pytest.mark.parametrize("damage", ["gone", "truncated", "torn", "foreign"])
def test_a_broken_record_is_dropped_and_a_whole_one_stays(
    tmp_path: Path, damage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path))
    store = ArtifactStore(tmp_path / "store")
    policy = RequestPolicy(request_for=given)
    record = tmp_path / "results" / record_key(request())
    value = result(store)
    write_record(record, value)
    key(policy, request())
    assert recorded(record, store) == value
    blob = store.path(value.outputs["o"])
    blob.chmod(0o644)
    if damage == "gone":
        blob.unlink()
    elif damage == "truncated":
        blob.write_bytes(b"con")
    elif damage == "torn":
        record.write_text(record.read_text()[:50])
    else:
        record.write_text('{"result": "[1, 2]"}')
    key(policy, request())
    assert not record.exists()


def test_a_record_that_somebody_is_writing_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path))
    theirs, ours = FileLocks(lambda: tmp_path / "locks"), FileLocks(lambda: tmp_path / "locks")
    policy = RequestPolicy(request_for=given)
    policy.lock_manager = ours
    record = tmp_path / "results" / record_key(request())
    record.parent.mkdir()
    record.write_text("half a rec")
    assert theirs.acquire_lock(record.name, "writer", acquire_timeout=0)
    key(policy, request())
    assert record.exists()
    theirs.release_lock(record.name, "writer")
    key(policy, request())
    assert not record.exists()


def test_a_lock_has_one_holder_at_a_time(tmp_path: Path) -> None:
    one, two = FileLocks(lambda: tmp_path), FileLocks(lambda: tmp_path)
    assert one.acquire_lock("k", "a")
    assert one.acquire_lock("k", "a")  # again is fine
    assert not one.acquire_lock("k", "b", acquire_timeout=0)
    assert not two.acquire_lock("k", "a", acquire_timeout=0)
    assert two.is_locked("k")
    assert not two.wait_for_lock("k", timeout=0)
    assert two.acquire_lock("other", "a", acquire_timeout=0)
    with pytest.raises(ValueError, match="does not hold"):
        two.release_lock("k", "a")
    one.release_lock("k", "a")
    assert not two.is_locked("k")
    assert two.acquire_lock("k", "b", acquire_timeout=0)
    assert two.is_lock_holder("k", "b")
    assert not one.is_lock_holder("k", "a")


def test_threads_take_turns(tmp_path: Path) -> None:
    locks = FileLocks(lambda: tmp_path)
    inside: list[int] = []

    def work(number: int) -> None:
        locks.acquire_lock("k", str(number))
        inside.append(number)
        assert len(inside) == 1
        time.sleep(0.01)
        inside.remove(number)
        locks.release_lock("k", str(number))

    threads = [threading.Thread(target=work, args=(n,)) for n in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert inside == []


def test_a_killed_holder_leaves_no_lock(tmp_path: Path) -> None:
    program = (
        "import sys, time; from pathlib import Path; from flows.engine.file_locks import FileLocks\n"
        "locks = FileLocks(lambda: Path(sys.argv[1])); locks.acquire_lock('k', 'a')\n"
        "print('held', flush=True); time.sleep(60)"
    )
    holder = subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None
    assert holder.stdout.readline() == "held\n"
    locks = FileLocks(lambda: tmp_path)
    assert not locks.acquire_lock("k", "b", acquire_timeout=0)
    holder.kill()
    holder.wait()
    holder.stdout.close()
    assert locks.acquire_lock("k", "b", acquire_timeout=0)


def test_where_the_kernel_has_no_locks_none_is_taken_that_would_outlive_its_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def flock(handle: int, operation: int) -> None:
        raise OSError(errno.ENOSYS, "no locks here")

    monkeypatch.setattr("fcntl.flock", flock)
    with pytest.raises((OSError, NotImplementedError)):
        FileLocks(lambda: tmp_path).acquire_lock("k", "a")
    assert not [path for path in tmp_path.iterdir() if path.read_bytes()]
