"""Leases of running conversions on artifacts of a store, and the lock of the garbage collection.

running/KEY.json    lease of an item that is being converted
collecting.lock     in a folder: empty file, locked by the kernel while `dg4d store gc` removes artifacts
collecting/         in an object store: lock, present during that time
"""

import hashlib
import os
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import PurePosixPath

from pydantic import Field, ValidationError

from dg4d_lib.errors import BadInput
from flows.processes import OWN_START, host_id, locked, start_of
from steps.contract import ArtifactRef, Digest, Frozen
from steps.store.artifact_store import ArtifactStore, Entry

FOLDER = "running"
FOLDER_LOCK = "collecting.lock"  # without content, which a full disk could not take
FOLDER_LOCK_S = 1.0  # readers hold the lock briefly
LOCK = "collecting/lock.json"
LOCK_S = 900.0  # a lock of another machine is stale if it is not refreshed for so long
POLL_S = 0.2
LONGEST_RUN_S = 7 * 24 * 3600.0  # a lease of another machine is stale after this time
_BEGAN = time.monotonic()


class Holder(Frozen):
    """Identity of a process that uses a store.

    Attributes:
        host: identity of its machine or container.
        pid: process id.
        start: start time in kernel ticks, since process ids are reused.
    """

    host: str = Field(default_factory=host_id)
    pid: int = Field(default_factory=os.getpid)
    start: str = OWN_START

    def is_gone(self, silent_s: float, patience_s: float) -> bool:
        """Return true if the process has ended, or, on another machine, was silent for longer than `patience_s`."""
        return start_of(self.pid) != self.start if self.host == host_id() else silent_s > patience_s


class Lease(Holder):
    """Artifacts that one process needs for one item.

    Attributes:
        item: name of the asset, or the output folder of several.
        age_s: age of the process when it wrote the lease.
        artifacts: sources and cached results that it uses; new ones are protected by their age.
    """

    item: str
    age_s: float
    artifacts: tuple[Digest, ...]


class Collecting(Holder):
    """Process that collects garbage."""

    token: str


@contextmanager
def running(store: ArtifactStore, item: str, given: Iterable[ArtifactRef] = ()) -> Iterator[None]:
    """Hold a lease for an item while the block runs, which also protects what this process stores meanwhile.

    Args:
        store: store of the artifacts.
        item: name of the asset, or the output folder of several.
        given: artifacts that were stored before.

    Raises:
        StoreUnreachable: the store does not answer.
    """
    with _mutex:
        _users[item] = _users.get(item, 0) + 1
    try:
        hold(store, item, (ref.digest for ref in given))
        yield
    finally:
        with _mutex:
            _users[item] -= 1
            last = not _users[item]
            if last:
                del _users[item]
                _held.pop((store.address, item), None)
        if last:
            with suppress(Exception):  # a lease that remains is stale when this process ends
                store.remove([_name(item)])


def hold(store: ArtifactStore, item: str, artifacts: Iterable[str]) -> None:
    """Add artifacts to the lease of this process for an item.

    Raises:
        StoreUnreachable: the store does not answer.
    """
    with _mutex:
        known = _held.get((store.address, item))
        needed = {*(known or ()), *artifacts}
        if needed == known:
            return
        lease = Lease(item=item, age_s=time.monotonic() - _BEGAN, artifacts=tuple(sorted(needed)))
        store.write(_name(item), lease.model_dump_json())
        _held[store.address, item] = needed


def needed(store: ArtifactStore, now: float) -> tuple[set[str], float]:
    """Return the artifacts of all leases, and the start of the oldest run (`now` if there is none).

    Stale leases are removed.

    Raises:
        StoreUnreachable: the store does not answer.
    """
    artifacts: set[str] = set()
    since = now
    for entry in list(store.entries(FOLDER)):
        lease = _read(store, entry)
        if lease is None or lease.is_gone(now - entry.modified, LONGEST_RUN_S):
            store.remove([entry.name])
            continue
        artifacts.update(lease.artifacts)
        since = min(since, entry.modified - lease.age_s)
    return artifacts, since


@contextmanager
def collecting(store: ArtifactStore) -> Iterator[Callable[[], None]]:
    """Hold the lock of the garbage collection; yield a function that refreshes it.

    Raises:
        BadInput: another process holds it.
        StoreUnreachable: the store does not answer.
    """
    if store.is_folder:
        with locked(store.root / FOLDER_LOCK, patience_s=FOLDER_LOCK_S) as free:
            if not free:
                raise _already_collecting(store)
            yield lambda: None
        return
    text = Collecting(token=uuid.uuid4().hex).model_dump_json()
    while not store.create(LOCK, text) and store.read(LOCK) != text.encode():  # a retried request finds its own lock
        if _is_collecting(store):
            raise _already_collecting(store)
        store.remove([LOCK])
    try:
        yield lambda: store.write(LOCK, text)
    finally:
        store.remove([LOCK])


def wait_for_collecting(store: ArtifactStore) -> bool:
    """Wait until no garbage collection runs; return true if one did.

    Raises:
        StoreUnreachable: the store does not answer.
    """
    waited = False
    while _is_collecting(store):
        waited = True
        time.sleep(POLL_S)
    return waited


_held: dict[tuple[str, str], set[str]] = {}
_users: dict[str, int] = {}
_mutex = threading.Lock()


def _name(item: str) -> str:
    key = hashlib.sha256(f"{host_id()} {os.getpid()} {OWN_START} {item}".encode()).hexdigest()
    return f"{FOLDER}/{key[:32]}.json"


def _read(store: ArtifactStore, entry: Entry) -> Lease | None:
    try:
        return Lease.model_validate_json(store.read(entry.name) or b"")
    except ValidationError:
        return None


def _already_collecting(store: ArtifactStore) -> BadInput:
    return BadInput(f"another `dg4d store gc` is removing artifacts from {store.address}; try again when it has ended")


def _is_collecting(store: ArtifactStore) -> bool:
    """Return true if a live process holds the lock."""
    if store.is_folder:
        with locked(store.root / FOLDER_LOCK, shared=True) as free:
            return not free
    if (content := store.read(LOCK)) is None:
        return False
    written = next((entry.modified for entry in store.entries(PurePosixPath(LOCK).parent.as_posix())), None)
    silent_s = 0.0 if written is None else abs(store.now() - written)  # clocks of machines differ
    try:
        return not Collecting.model_validate_json(content).is_gone(silent_s, LOCK_S)
    except ValidationError:  # the holder is writing it
        return silent_s <= LOCK_S
