import os
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest
from obstore.store import LocalStore, MemoryStore
from tiny_s3 import BUCKET, TinyS3

from dg4d_lib.errors import BackendUnavailable, BadInput
from steps.contract import ArtifactRef
from steps.store import bucket
from steps.store.artifact_store import ArtifactMissing, ArtifactStore, StoreUnreachable, object_name
from steps.store.bucket import BucketStore
from steps.store.opening import open_store

REAL_S3 = os.environ.get("DG4D_TEST_S3")  # s3://BUCKET/PREFIX of a server that may be written to, with AWS_* variables
NOTHING = ArtifactRef(digest="sha256:" + "0" * 64, media_type="a/b", size_bytes=1)


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[TinyS3]:
    running = TinyS3()
    for name, value in running.environment.items():
        monkeypatch.setenv(name, value)
    yield running
    running.stop()


@pytest.fixture(params=["folder", "memory", "tiny s3", "real s3"])
def store(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ArtifactStore:
    """A new, empty store of every kind."""
    monkeypatch.setenv("DG4D_HOME", str(tmp_path / "home"))
    match request.param:
        case "folder":
            return open_store(tmp_path / "store")
        case "memory":
            return BucketStore(MemoryStore(), tmp_path / "copies", "memory")
        case "tiny s3":
            request.getfixturevalue("server")
            return open_store(f"s3://{BUCKET}/some/prefix-{uuid.uuid4()}", patience_s=5)
    if not REAL_S3:
        pytest.skip("DG4D_TEST_S3 names no S3 server that tests may write to")
    return open_store(f"{REAL_S3}/{uuid.uuid4()}", patience_s=20)


def forget_copies(store: ArtifactStore) -> None:
    """As if another machine had written what is in the bucket."""
    if isinstance(store, BucketStore):
        for path in store.root.rglob("*"):
            if path.is_file():
                path.unlink()


def copy_of(store: ArtifactStore, ref: ArtifactRef) -> Path:
    return store.root / object_name(ref.digest)


def overwrite(path: Path, content: bytes) -> None:
    path.chmod(0o644)
    path.write_bytes(content)


def test_what_was_put_is_there_for_every_machine(store: ArtifactStore, tmp_path: Path) -> None:
    content = bytes(range(256)) * 50_000  # more than one part of an upload
    (tmp_path / "a").write_bytes(content)
    ref = store.put(tmp_path / "a", "x/y")
    assert store.put_bytes(content, "x/y") == ref
    assert store.has(ref) and store.is_sound(ref)
    forget_copies(store)
    store.get(ref, tmp_path / "b")
    assert (tmp_path / "b").read_bytes() == store.path(ref).read_bytes() == content
    assert store.content_digest(ref.digest) == ref.digest
    (entry,) = store.artifacts()
    assert (entry.name, entry.size_bytes) == (ref.digest, len(content))
    assert abs(store.now() - entry.modified) < 600
    store.drop([ref.digest, NOTHING.digest])
    assert not store.has(ref) and not store.is_sound(ref)
    assert store.content_digest(ref.digest) is None
    assert list(store.artifacts()) == []
    with pytest.raises(ArtifactMissing, match="run the same command again"):
        store.path(ref)


def test_small_files_are_kept_by_name(store: ArtifactStore) -> None:
    assert store.read("a/one.json") is None
    store.write("a/one.json", "1")
    store.write("a/one.json", "2")
    assert store.read("a/one.json") == b"2"
    assert not store.create("a/one.json", "3")
    assert store.create("a/two.json", "4")
    assert sorted(entry.name for entry in store.entries("a")) == ["a/one.json", "a/two.json"]
    assert list(store.entries("b")) == []
    store.remove(["a/one.json", "a/never.json"])
    assert [entry.name for entry in store.entries("a")] == ["a/two.json"]
    assert store.read("a/one.json") is None


def test_of_many_who_create_a_file_one_wins(store: ArtifactStore) -> None:
    won: list[int] = []
    start = threading.Barrier(6)

    def attempt(number: int) -> None:
        start.wait()
        if store.create("lock", str(number)):
            won.append(number)

    threads = [threading.Thread(target=attempt, args=(number,)) for number in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    (winner,) = won
    assert store.read("lock") == str(winner).encode()


def test_flipped_bytes_are_found_whoever_reads(store: ArtifactStore, tmp_path: Path) -> None:
    ref = store.put_bytes(b"0123456789", "a/b")
    assert store.path(ref).read_bytes() == b"0123456789"
    overwrite(copy_of(store, ref), b"0123X56789")
    if isinstance(store, BucketStore):  # the copy was damaged, the bucket was not
        assert store.path(ref).read_bytes() == b"0123456789"
        overwrite(copy_of(store, ref), b"0123X56789")
        store.get(ref, tmp_path / "out")
        assert (tmp_path / "out").read_bytes() == b"0123456789"
        return
    assert not store.is_sound(ref)
    with pytest.raises(ArtifactMissing, match="damaged"):
        store.path(ref)
    assert not store.has(ref)


def test_what_is_damaged_in_the_bucket_is_dropped_and_can_be_put_again(tmp_path: Path) -> None:
    store = BucketStore(LocalStore(tmp_path / "bucket", mkdir=True), tmp_path / "copies", "local")
    ref = store.put_bytes(b"0123456789", "a/b")
    forget_copies(store)
    (tmp_path / "bucket" / object_name(ref.digest)).write_bytes(b"0123X56789")
    assert store.has(ref)
    assert store.content_digest(ref.digest) != ref.digest
    with pytest.raises(ArtifactMissing):
        store.path(ref)
    assert not store.has(ref)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []
    assert store.put_bytes(b"0123456789", "a/b") == ref
    assert store.path(ref).read_bytes() == b"0123456789"


def test_what_nobody_used_for_long_is_no_longer_copied(tmp_path: Path) -> None:
    store = BucketStore(MemoryStore(), tmp_path / "copies", "memory")
    used, unused = store.put_bytes(b"used", "a/b"), store.put_bytes(b"unused", "a/b")
    left = tmp_path / "copies" / "incoming" / "left"
    left.write_bytes(b"half")
    for path in (copy_of(store, used), copy_of(store, unused), left):
        os.utime(path, (time.time() - 1000, time.time() - 1000))
    store.path(used)
    store.tidy(500)
    assert copy_of(store, used).exists()
    assert not copy_of(store, unused).exists() and not left.exists()
    assert store.path(unused).read_bytes() == b"unused"


def test_a_store_that_does_not_answer_is_a_clear_error_and_its_return_ends_the_waiting(
    server: TinyS3, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path))
    hasty, patient = (open_store(f"s3://{BUCKET}/{uuid.uuid4()}", patience_s=s) for s in (0.3, 30))
    ref = patient.put_bytes(b"before", "a/b")
    server.stop()
    for attempt in (lambda: hasty.put_bytes(b"x", "a/b"), lambda: hasty.has(ref), lambda: list(hasty.artifacts())):
        with pytest.raises(StoreUnreachable, match=rf"{hasty.address} does not answer .*run the same command again"):
            attempt()
    back = threading.Timer(1.0, server.start)
    back.start()
    assert patient.put_bytes(b"after", "a/b").size_bytes == 5
    back.join()
    forget_copies(patient)
    assert patient.path(ref).read_bytes() == b"before"


def test_trouble_with_a_bucket_is_told_without_secrets(server: TinyS3, tmp_path: Path) -> None:
    with pytest.raises(BackendUnavailable, match="no such bucket") as caught:
        open_store(f"s3://other/{uuid.uuid4()}", patience_s=1).put_bytes(b"x", "a/b")
    assert "secret that" not in str(caught.value)


def test_plain_http_goes_to_this_machine_only(server: TinyS3, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    open_store(f"s3://{BUCKET}/{uuid.uuid4()}", patience_s=0.1).put_bytes(b"x", "a/b")
    monkeypatch.delenv("AWS_ALLOW_HTTP", raising=False)
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://192.0.2.1:9")  # an address for documents, which nobody has
    begin = time.monotonic()
    with pytest.raises(BackendUnavailable):
        open_store(f"s3://{BUCKET}/{uuid.uuid4()}", patience_s=5).has(NOTHING)
    assert time.monotonic() - begin < 4  # refused by the client; nobody was asked


@pytest.mark.parametrize(("allowed", "goes"), [("true", True), ("1", True), ("false", False), ("", False)])
def test_plain_http_goes_elsewhere_where_the_environment_allows_it(
    server: TinyS3, monkeypatch: pytest.MonkeyPatch, allowed: str, goes: bool
) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.1:{server.port}")  # not a name that stands for this machine
    monkeypatch.setenv("AWS_ALLOW_HTTP", allowed)
    store = open_store(f"s3://{BUCKET}/{uuid.uuid4()}", patience_s=1)
    if goes:
        assert store.path(store.put_bytes(b"x", "a/b")).read_bytes() == b"x"
    else:
        with pytest.raises(StoreUnreachable):
            store.has(NOTHING)


def test_the_environment_chooses_the_store(server: TinyS3, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DG4D_HOME", str(tmp_path))
    assert open_store().address == str(tmp_path / "store")
    monkeypatch.setenv("DG4D_STORE", f"s3://{BUCKET}/p")
    assert open_store().address == f"s3://{BUCKET}/p"
    ref = open_store().put_bytes(b"x", "a/b")
    assert list(server.objects) == [f"p/{object_name(ref.digest)}"]
    for wrong in ("https://somewhere/p", "s3:///p"):
        with pytest.raises(BadInput, match="neither a folder nor of the form"):
            open_store(wrong)


def test_two_processes_put_the_same_artifact_at_once(store: ArtifactStore, tmp_path: Path) -> None:
    if store.address == "memory":
        pytest.skip("another process cannot open it by its address")
    program = (
        "import sys; from steps.store.opening import open_store\n"
        "print(open_store(sys.argv[1]).put_bytes(b'0123456789' * 100000, 'a/b').digest)"
    )
    command = [sys.executable, "-c", program, store.address]
    both = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    digests = {process.communicate()[0].strip() for process in both}
    (entry,) = store.artifacts()
    assert digests == {entry.name}
    assert store.content_digest(entry.name) == entry.name


def test_without_the_library_folders_are_opened_and_buckets_say_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "steps.store.bucket", None)
    assert open_store(tmp_path).root == tmp_path
    with pytest.raises(BackendUnavailable, match="make setup"):
        open_store("s3://no-library/at-all")


def test_an_equal_object_is_young_again_when_it_is_old(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = BucketStore(MemoryStore(), tmp_path / "copies", "memory")

    def put() -> float:
        time.sleep(0.01)
        store.put_bytes(b"same", "a/b")
        (entry,) = store.artifacts()
        return entry.modified

    first = put()
    assert put() == first  # not uploaded again
    monkeypatch.setattr(bucket, "RENEW_S", 0.0)
    assert put() > first
