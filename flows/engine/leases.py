"""Who is at work in a store: runs, with what they need of it, and the one that removes what nobody needs.

running/KEY.json    a lease per item that is being made
collecting/         a lock, there while `dg4d store gc` removes things
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
from flows.processes import OWN_START, host_id, start_of
from steps.contract import Digest, Frozen
from steps.store.artifact_store import ArtifactStore, Entry

FOLDER = "running"
LOCK = "collecting/lock.json"
LOCK_S = 900.0  # without a sign of life, on another machine, the one that removes things has died
POLL_S = 0.2
LONGEST_RUN_S = 7 * 24 * 3600.0  # of a run on another machine, whose end cannot be seen from here
_BEGAN = time.monotonic()


class Holder(Frozen):
    """Process that works in a store.

    Attributes:
        host: the machine, or its container.
        pid: the process.
        start: when it began, in the ticks of its kernel.
    """

    host: str = Field(default_factory=host_id)
    pid: int = Field(default_factory=os.getpid)
    start: str = OWN_START

    def is_gone(self, silent_s: float, patience_s: float) -> bool:
        """Return whether it has ended; on another machine, whether it was silent for longer than the patience."""
        return start_of(self.pid) != self.start if self.host == host_id() else silent_s > patience_s


class Lease(Holder):
    """What one process needs for one item.

    Attributes:
        item: what is being made.
        age_s: how long the process had been at work when it wrote this.
        artifacts: results of earlier runs that it uses; those it makes are protected by their age.
    """

    item: str
    age_s: float
    artifacts: tuple[Digest, ...]


class Collecting(Holder):
    """The process that removes what nobody needs."""

    token: str


@contextmanager
def running(store: ArtifactStore, item: str) -> Iterator[None]:
    """Say that an item is being made, as long as the block runs.

    Raises:
        StoreUnreachable: the store does not answer.
    """
    with _mutex:
        _users[item] = _users.get(item, 0) + 1
    try:
        hold(store, item, ())
        yield
    finally:
        with _mutex:
            _users[item] -= 1
            last = not _users[item]
            if last:
                del _users[item]
                _held.pop((store.address, item), None)
        if last:
            with suppress(Exception):  # a lease that stays ends with this process
                store.remove([_name(item)])


def hold(store: ArtifactStore, item: str, artifacts: Iterable[str]) -> None:
    """Add artifacts to what this process needs for an item.

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
    """What all runs need, and since when the oldest of them is at work (`now` if there are none).

    Leases of processes that are gone are removed.

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
    """Be the only one that removes things; gives what to call now and then as a sign of life.

    Raises:
        BadInput: another one is at it.
        StoreUnreachable: the store does not answer.
    """
    text = Collecting(token=uuid.uuid4().hex).model_dump_json()
    while not store.create(LOCK, text) and store.read(LOCK) != text.encode():  # a repeated request may find its own
        if _is_collecting(store):
            raise BadInput(f"somebody else is removing things from {store.address} at the moment; try again later")
        store.remove([LOCK])
    try:
        yield lambda: store.write(LOCK, text)
    finally:
        store.remove([LOCK])


def wait_for_collecting(store: ArtifactStore) -> bool:
    """Wait until nobody removes things; whether somebody did.

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


def _is_collecting(store: ArtifactStore) -> bool:
    """Return whether the lock is held by somebody who is alive."""
    if (content := store.read(LOCK)) is None:
        return False
    written = next((entry.modified for entry in store.entries(PurePosixPath(LOCK).parent.as_posix())), None)
    silent_s = 0.0 if written is None else abs(store.now() - written)  # clocks may differ, either way
    try:
        return not Collecting.model_validate_json(content).is_gone(silent_s, LOCK_S)
    except ValidationError:  # it is being written
        return silent_s <= LOCK_S
