"""Cache policy of steps: request digests as keys, checked against the artifacts in the store.

Prefect's own policies hash arguments and source text, which miss weights and code of the step; its lock files outlive
their process.
"""

import asyncio
import hashlib
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from prefect.cache_policies import CachePolicy
from prefect.context import TaskRunContext

from flows import home
from flows.engine.records import read_record, record_key
from flows.engine.shared_results import fetch_result
from steps.contract import StepRequest, StepResult
from steps.store.artifact_store import ArtifactStore, StoreUnreachable

POLL_S = 0.1  # between two attempts to take a lock


def recorded(path: Path, store: ArtifactStore) -> StepResult | None:
    """Return the result in a record, if all its artifacts are in the store and intact; else None.

    Raises:
        StoreUnreachable: the store does not answer.
    """
    result = read_record(path)
    return result if result and all(store.is_sound(ref) for ref in result.outputs.values()) else None


@dataclass
class RequestPolicy(CachePolicy):
    """Cache key of a task that runs a step: the digest of its request. Drops records that are broken.

    Attributes:
        request_for: returns the request, given the name of the task and its arguments.
    """

    request_for: Callable[[str, Mapping[str, Any]], StepRequest] | None = None

    def compute_key(
        self, task_ctx: TaskRunContext, inputs: dict[str, Any], flow_parameters: dict[str, Any], **_: Any
    ) -> str | None:
        """Return the name of the request's record."""
        assert self.request_for is not None  # the base class has defaults, so this field needs one
        key = record_key(self.request_for(task_ctx.task.name, inputs))
        record = home.records() / key
        with suppress(StoreUnreachable):  # a record that cannot be checked is used
            fetch_result(key, record)
            if record.exists() and recorded(record, home.store()) is None:
                self._drop(record, key)
        return key

    def _drop(self, record: Path, key: str) -> None:
        """Remove a broken record, unless another process is writing it."""
        lock = self.lock_manager
        holder = f"heal-{threading.get_ident()}"
        if not isinstance(lock, FileLocks):
            record.unlink(missing_ok=True)
        elif lock.acquire_lock(key, holder, acquire_timeout=0):
            try:
                if recorded(record, home.store()) is None:
                    record.unlink(missing_ok=True)
            finally:
                lock.release_lock(key, holder)


class FileLocks:
    """Locks between the processes of one host, for Prefect's transactions; the kernel frees them with their process.

    Args:
        folder: returns the folder of the lock files; they stay, empty.
    """

    def __init__(self, folder: Callable[[], Path]) -> None:
        self._folder = folder
        self._held: dict[str, tuple[str, FileLock]] = {}

    def __deepcopy__(self, memo: dict[int, Any]) -> "FileLocks":
        return self  # a copied policy locks with the same locks

    def acquire_lock(
        self, key: str, holder: str, acquire_timeout: float | None = None, hold_timeout: float | None = None
    ) -> bool:
        """Wait for the lock; return false after `acquire_timeout` seconds. A lock is held until it is released."""
        if not self.is_lock_holder(key, holder):
            lock = self._waited_for(key, acquire_timeout)
            if lock is None:
                return False
            self._held[key] = (holder, lock)
        return True

    def release_lock(self, key: str, holder: str) -> None:
        """Give the lock back.

        Raises:
            ValueError: this holder does not have it.
        """
        if not self.is_lock_holder(key, holder):
            raise ValueError(f"{holder} does not hold the lock of {key}")
        self._held.pop(key)[1].release()

    def is_locked(self, key: str) -> bool:
        """Return true if a process holds the lock, this one or another."""
        return not self.wait_for_lock(key, 0)

    def is_lock_holder(self, key: str, holder: str) -> bool:
        """Return true if this holder has the lock."""
        return self._held.get(key, ("", None))[0] == holder

    def wait_for_lock(self, key: str, timeout: float | None = None) -> bool:
        """Wait until the lock is free; return false after `timeout` seconds."""
        if (lock := self._waited_for(key, timeout)) is not None:
            lock.release()
        return lock is not None

    async def aacquire_lock(self, *arguments: Any, **named: Any) -> bool:
        """Do the same as `acquire_lock`."""
        return await asyncio.to_thread(self.acquire_lock, *arguments, **named)

    async def await_for_lock(self, key: str, timeout: float | None = None) -> bool:
        """Do the same as `wait_for_lock`."""
        return await asyncio.to_thread(self.wait_for_lock, key, timeout)

    def _waited_for(self, key: str, timeout: float | None) -> FileLock | None:
        """Return the lock, held; None after `timeout` seconds."""
        path = self._folder() / (hashlib.sha256(key.encode()).hexdigest() + ".lock")
        lock = FileLock(path, thread_local=False, fallback_to_soft=False)  # a soft lock outlives its process
        try:
            lock.acquire(timeout=-1 if timeout is None else timeout, poll_interval=POLL_S)
        except Timeout:
            return None
        return lock
