import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import pytest
from obstore.store import MemoryStore
from records import result_with, write_record
from typer.testing import CliRunner

from dg4d_lib.errors import BadInput
from flows.commands.store import store as command
from flows.engine import leases
from flows.engine.collecting import collect
from flows.engine.versions import Version, VersionStep, faults, versions
from steps.contract import ArtifactRef
from steps.store.artifact_store import ArtifactStore, object_name
from steps.store.bucket import BucketStore
from steps.store.opening import open_store

DAY = 24 * 3600.0
LATER = 0.05  # seconds after which what was just written is old for these tests


@pytest.fixture(params=["folder", "memory"])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> ArtifactStore:
    if request.param == "folder":
        return ArtifactStore(tmp_path / "store")
    return BucketStore(MemoryStore(), tmp_path / "copies", "memory")


def version(store: ArtifactStore, item: str, words: str, finished: str = "2026-01-01T00:00:00+00:00") -> Version:
    """A version with artifacts of its own and a source that it shares with the others of its item; recorded."""
    outputs = {"motion": store.put_bytes(f"motion {words}".encode(), "a/b").digest}
    source = store.put_bytes(f"source of {item}".encode(), "a/b")
    made = Version(
        item=item,
        order=store.put_bytes(f"order {words}".encode(), "a/b").digest,  # any digest will do
        package=store.put_bytes(f"package {words}".encode(), "a/b"),
        finished=finished,
        profile="preview",
        seed=0,
        source=source,
        steps=(
            VersionStep(label="fit_motion", record=outputs["motion"], inputs={"x": source.digest}, outputs=outputs),
        ),
    )
    store.drop([made.order])
    store.write(made.name, made.model_dump_json())
    return made


def here(store: ArtifactStore) -> set[str]:
    return {entry.name for entry in store.artifacts()}


def test_a_version_says_what_it_needs_and_what_for(store: ArtifactStore) -> None:
    made = version(store, "cat", "one")
    assert sorted(made.artifacts().values()) == ["fit_motion: motion", "package", "source"]
    assert versions(store) == [made]


def test_versions_come_by_item_and_the_newest_first_whatever_their_names(store: ArtifactStore) -> None:
    for item, words, day in (("b/ä", "1", 1), ("a", "2", 2), ("b/ä", "3", 3), ("b-ä", "4", 2)):
        version(store, item, words, f"2026-01-0{day}T00:00:00+00:00")
    assert [(v.item, v.finished[9]) for v in versions(store)] == [("a", "2"), ("b-ä", "2"), ("b/ä", "3"), ("b/ä", "1")]


def test_what_nobody_needs_goes_and_what_a_version_needs_stays(store: ArtifactStore, tmp_path: Path) -> None:
    made = version(store, "cat", "one")
    useless = store.put_bytes(b"of a run that failed", "a/b")
    young = collect(store, tmp_path / "results")
    assert young.artifacts == [] and useless.digest in here(store)
    time.sleep(LATER)
    tried = collect(store, tmp_path / "results", dry_run=True, grace_s=0)
    assert [entry.name for entry in tried.artifacts] == [useless.digest]
    assert useless.digest in here(store)
    done = collect(store, tmp_path / "results", grace_s=0)
    assert done == tried
    assert here(store) == set(made.artifacts())
    assert faults(store, versions(store), {entry.name: entry.size_bytes for entry in store.artifacts()}) == {}


def test_only_the_newest_versions_of_each_item_stay_if_so_many_are_asked_for(
    store: ArtifactStore, tmp_path: Path
) -> None:
    old, middle, new = (version(store, "cat", str(day), f"2026-01-0{day}T00:00:00+00:00") for day in (1, 2, 3))
    dog = version(store, "dog", "wow", "2025-01-01T00:00:00+00:00")
    time.sleep(LATER)
    gone = collect(store, tmp_path / "results", keep=2, grace_s=0)
    assert gone.versions == [old]
    assert versions(store) == [new, middle, dog]
    assert here(store) == {*new.artifacts(), *middle.artifacts(), *dog.artifacts()}
    assert old.source.digest in here(store)  # the others need it too


def test_what_a_run_uses_stays_until_the_run_has_ended(store: ArtifactStore, tmp_path: Path) -> None:
    used = store.put_bytes(b"a result of long ago", "a/b")
    time.sleep(LATER)
    with leases.running(store, "cat"):
        leases.hold(store, "cat", [used.digest])
        leases.hold(store, "cat", [used.digest])
        assert collect(store, tmp_path / "results", grace_s=0).artifacts == []
    assert list(store.entries("running")) == []
    assert [entry.name for entry in collect(store, tmp_path / "results", grace_s=0).artifacts] == [used.digest]


def test_what_was_written_since_the_oldest_run_began_stays(
    store: ArtifactStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recent = store.put_bytes(b"of this run", "a/b")
    time.sleep(LATER)
    monkeypatch.setattr(leases, "_BEGAN", time.monotonic() - 60)  # this process is at work for a minute
    with leases.running(store, "cat"):
        assert collect(store, tmp_path / "results", grace_s=0).artifacts == []
        assert recent.digest in here(store)


def test_a_lease_keeps_what_it_had_when_more_is_needed(store: ArtifactStore) -> None:
    given, found = (store.put_bytes(name, "a/b") for name in (b"given", b"found"))
    with leases.running(store, "cat", [given]):
        leases.hold(store, "cat", [found.digest])
        artifacts, _ = leases.needed(store, store.now())
    assert artifacts == {given.digest, found.digest}


def test_two_runs_of_one_item_share_a_lease(store: ArtifactStore) -> None:
    with leases.running(store, "cat"):
        with leases.running(store, "cat"):
            pass
        assert len(list(store.entries("running"))) == 1
    assert list(store.entries("running")) == []


PROGRAM = """
import sys, time
from flows.engine import leases
from steps.store.opening import open_store
store = open_store(sys.argv[1])
with (leases.collecting(store) if sys.argv[2] == "collect" else leases.running(store, "cat")):
    if sys.argv[2] != "collect":
        leases.hold(store, "cat", [sys.argv[2]])
    print("there", flush=True)
    time.sleep(60)
"""


def other_process(store: ArtifactStore, what: str) -> "subprocess.Popen[str]":
    process = subprocess.Popen([sys.executable, "-c", PROGRAM, store.address, what], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "there\n"
    return process


def killed(process: "subprocess.Popen[str]") -> None:
    process.kill()
    process.communicate()


def test_a_lease_ends_with_its_process_however_that_ends(tmp_path: Path) -> None:
    store = ArtifactStore(tmp_path / "store")
    used = store.put_bytes(b"used", "a/b")
    os.utime(store.path(used), (0, 0))
    process = other_process(store, used.digest)
    assert collect(store, tmp_path / "results").artifacts == []
    killed(process)
    assert [entry.name for entry in collect(store, tmp_path / "results").artifacts] == [used.digest]


def test_things_are_removed_from_a_full_disk(tmp_path: Path, no_room: AbstractContextManager[None]) -> None:
    store = ArtifactStore(tmp_path / "store")
    useless = store.put_bytes(b"useless", "a/b")
    os.utime(store.path(useless), (0, 0))
    with no_room:
        gone = collect(store, tmp_path / "results").artifacts
    assert [entry.name for entry in gone] == [useless.digest]
    assert not store.has(useless)


def test_one_removes_things_at_a_time_and_one_that_was_killed_is_in_nobodys_way(tmp_path: Path) -> None:
    store = ArtifactStore(tmp_path / "store")
    process = other_process(store, "collect")
    with pytest.raises(BadInput, match="another `dg4d store gc`"):
        collect(store, tmp_path / "results")
    killed(process)
    assert not leases.wait_for_collecting(store)
    collect(store, tmp_path / "results")


def test_a_lock_of_another_machine_is_believed_as_long_as_it_gives_signs_of_life(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = BucketStore(MemoryStore(), tmp_path / "copies", "memory")
    lock = {"host": "elsewhere", "pid": 1, "start": "1", "token": "t"}
    store.write(leases.LOCK, json.dumps(lock))
    with pytest.raises(BadInput, match="another `dg4d store gc`"):
        collect(store, tmp_path / "results")
    monkeypatch.setattr(leases, "LOCK_S", -1.0)
    collect(store, tmp_path / "results")
    assert list(store.entries("collecting")) == []


def test_a_lock_that_is_half_written_is_believed_until_it_is_old(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = BucketStore(MemoryStore(), tmp_path / "copies", "memory")
    store.write(leases.LOCK, '{"host": "else')
    with pytest.raises(BadInput, match="another `dg4d store gc`"), leases.collecting(store):
        pass
    now = store.now()
    monkeypatch.setattr(store, "now", lambda: now + leases.LOCK_S + 60)
    with leases.collecting(store):
        pass
    assert store.read(leases.LOCK) is None


def test_a_version_that_is_recorded_while_things_are_removed_is_whole_or_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from flows.engine.versions import keep_version

    store = ArtifactStore(tmp_path / "store")
    template = version(store, "cat", "one")
    store.remove([template.name])

    class ConversionJob:  # as much of one as is asked
        item, profile, seed, source = "cat", "preview", 0, template.source
        bank = mask = depth = layers = views = asset = None

        def digest(self) -> str:
            return template.order

    class Made:
        package, steps = template.package, []

    job: Any = ConversionJob()
    made: Any = Made()
    removing, recorded = threading.Event(), threading.Event()
    results: list[Any] = []

    def slow_removal() -> None:
        with leases.collecting(store):
            removing.set()
            recorded.wait(5)  # it has read the records before
            store.drop([template.package.digest])

    remover = threading.Thread(target=slow_removal)
    remover.start()
    removing.wait(5)

    def keep() -> None:
        try:
            results.append(keep_version(store, job, made))
        except Exception as error:
            results.append(error)

    keeper = threading.Thread(target=keep)
    keeper.start()
    time.sleep(0.3)
    assert results == []  # it waits for the end
    recorded.set()
    remover.join()
    keeper.join()
    assert "package of cat was removed" in str(results[0])
    assert versions(store) == []
    store.put_bytes(b"package one", "a/b")
    keep_version(store, job, made)
    assert [v.item for v in versions(store)] == ["cat"]


def test_a_record_that_cannot_be_read_stops_every_removal(store: ArtifactStore, tmp_path: Path) -> None:
    made = version(store, "cat", "one")
    store.write(made.name, made.model_dump_json()[:40])
    time.sleep(LATER)
    with pytest.raises(BadInput, match=r"versions/cat-.* damaged, or of another version"):
        collect(store, tmp_path / "results", grace_s=0)
    assert made.package.digest in here(store)


def test_results_whose_artifacts_are_gone_go_too(tmp_path: Path) -> None:
    store, results = ArtifactStore(tmp_path / "store"), tmp_path / "results"
    kept = version(store, "cat", "one").package
    gone = ArtifactRef(digest="sha256:" + "1" * 64, media_type="a/b", size_bytes=1)
    results.mkdir()
    for name, ref in {"whole": kept, "broken": gone, "young": gone}.items():
        write_record(results / name, result_with(ref))
    (results / "torn").write_text('{"res')
    for name in ("whole", "broken", "torn"):
        os.utime(results / name, (0, 0))
    collect(store, results)
    assert sorted(path.name for path in results.iterdir()) == ["whole", "young"]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The command on the store of a home of its own."""
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "home"))
    monkeypatch.setenv("COLUMNS", "200")
    yield lambda *arguments: CliRunner().invoke(command, arguments)


def test_an_empty_store_is_shown_as_one(run: Any, tmp_path: Path) -> None:
    assert run("ls").stdout.startswith("0 items, 0 versions, 0 artifacts, 0.0 kB in ")
    assert run("verify").exit_code == 0
    assert run("gc").exit_code == 0
    done = run("show", "cat")
    assert done.exit_code == 65 and "none yet" in done.stderr


def test_the_command_shows_what_is_there(run: Any) -> None:
    store = open_store()
    one = version(store, "animals/cat", "one")
    other = version(store, "dog", "two")
    shown = run("ls").stdout
    assert shown.splitlines()[-1].startswith("2 items, 2 versions, 6 artifacts, ")
    assert one.order[7:19] in shown and "animals/cat" in shown and "2026-01-01 00:00:00 UTC" in shown
    store.write("versions/x.json", "{")
    assert run("ls").exit_code == 65
    store.remove(["versions/x.json"])
    motion = one.steps[0].outputs["motion"]
    for name in (motion, motion[7:15]):
        shown = run("show", name).stdout
        assert motion in shown and "fit_motion: motion of animals/cat" in shown and "dog" not in shown
    store.drop([other.package.digest])
    shown = run("show", "dog").stdout
    assert other.order in shown and "missing  package" in shown and "animals/cat" not in shown
    assert run("show", "0000000").exit_code == 65


def test_the_check_names_what_is_damaged_or_missing_and_whose_it_is(run: Any) -> None:
    store = open_store()
    made = version(store, "cat", "one")
    orphan = store.put_bytes(b"orphan", "a/b")
    assert run("verify").stdout == "4 artifacts of 1 versions are intact\n"
    for ref in (made.package, orphan):
        path = store.root / object_name(ref.digest)
        path.chmod(0o644)
        path.write_bytes(b"x" * ref.size_bytes)
    store.drop([made.source.digest])
    done = run("verify")
    assert done.exit_code == 65
    lines = set(done.stdout.splitlines())
    short = made.order[7:19]
    assert lines == {
        f"{made.package.digest} is damaged: package of cat, version {short}",
        f"{orphan.digest} is damaged: no version refers to it",
        f"{made.source.digest} is missing: source of cat, version {short}",
    }
    assert "3 of 4 artifacts" in done.stderr


def test_the_command_removes_and_says_so(run: Any) -> None:
    store = open_store()
    old = version(store, "cat", "one", "2025-01-01T00:00:00+00:00")
    version(store, "cat", "two")
    for entry in store.entries("sha256"):
        os.utime(store.root / entry.name, (time.time() - 2 * DAY,) * 2)
    tried = run("gc", "--keep", "1", "--dry-run").stdout
    assert "1 versions and 2 artifacts" in tried and "would be removed" in tried
    assert len(versions(store)) == 2
    done = run("gc", "--keep", "1").stdout
    assert f"version {old.order[7:19]} of cat" in done and "were removed" in done
    assert len(versions(store)) == 1 and len(here(store)) == 3
    assert run("gc", "--keep", "0").exit_code == 2
