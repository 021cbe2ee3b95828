"""When a step's result may be used again: strictly by the digest of its request, while its artifacts exist.

Prefect's own policies hash arguments and source text and miss what matters; its lock files outlive their process.
"""

import asyncio
import errno
import fcntl
import hashlib
import json
import os
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from prefect.cache_policies import CachePolicy
from prefect.context import TaskRunContext
from pydantic import ValidationError

from steps.contract import StepRequest, StepResult
from steps.store.artifact_store import ArtifactStore, StoreUnreachable
from steps.store.opening import open_store

POLL_S = 0.1  # between two looks at a lock that another process holds


def record_key(request: StepRequest) -> str:
    """The name of the record that says what a request gave."""
    return f"{request.step}-{request.digest().removeprefix('sha256:')}"


def recorded(path: Path, store: ArtifactStore) -> StepResult | None:
    """The result in a record that Prefect wrote, if it can be read and all its artifacts are there and sound.

    Raises:
        StoreUnreachable: the store does not answer.
    """
    try:
        result = StepResult.model_validate(json.loads(json.loads(path.read_text(encoding="utf-8"))["result"]))
    except (OSError, ValueError, KeyError, TypeError, ValidationError):
        return None
    return result if all(store.is_sound(ref) for ref in result.outputs.values()) else None


@dataclass
class RequestPolicy(CachePolicy):
    """The key of a task that is called with `request=StepRequest(...)`; drops its record when that is broken."""

    records: Path = Path()
    store: str = ""

    def compute_key(
        self, task_ctx: TaskRunContext, inputs: dict[str, Any], flow_parameters: dict[str, Any], **_: Any
    ) -> str | None:
        """The name of the request's record."""
        key = record_key(inputs["request"])
        record = self.records / key
        with suppress(StoreUnreachable):  # the record is good until the contrary is known
            if record.exists() and recorded(record, open_store(self.store)) is None:
                self._drop(record, key)
        return key

    def _drop(self, record: Path, key: str) -> None:
        """Remove a broken record, unless somebody is writing it at this moment."""
        lock = self.lock_manager
        holder = f"heal-{threading.get_ident()}"
        if not isinstance(lock, FileLocks):
            record.unlink(missing_ok=True)
        elif lock.try_lock(key, holder):
            try:
                if recorded(record, open_store(self.store)) is None:
                    record.unlink(missing_ok=True)
            finally:
                lock.release_lock(key, holder)


class FileLocks:
    """Locks between the processes of one host, for Prefect's transactions; the kernel frees them with their process.

    Args:
        folder: of the lock files; they stay, empty.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._held: dict[str, tuple[str, int]] = {}
        self._mutex = threading.Lock()

    def __deepcopy__(self, memo: dict[int, Any]) -> "FileLocks":
        return self  # a copied policy locks with the same locks

    def try_lock(self, key: str, holder: str) -> bool:
        """Take the lock if it is free; true also when this holder has it already."""
        with self._mutex:
            if key in self._held:
                return self._held[key][0] == holder
            self.folder.mkdir(parents=True, exist_ok=True)
            handle = os.open(self._path(key), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                os.close(handle)
                if error.errno in {errno.EWOULDBLOCK, errno.EAGAIN}:
                    return False
                raise
            self._held[key] = (holder, handle)
            return True

    def acquire_lock(
        self, key: str, holder: str, acquire_timeout: float | None = None, hold_timeout: float | None = None
    ) -> bool:
        """Wait for the lock; false after `acquire_timeout` seconds. A lock is held until it is released."""
        start = time.monotonic()
        while not self.try_lock(key, holder):
            if acquire_timeout is not None and time.monotonic() - start >= acquire_timeout:
                return False
            time.sleep(POLL_S)
        return True

    async def aacquire_lock(
        self, key: str, holder: str, acquire_timeout: float | None = None, hold_timeout: float | None = None
    ) -> bool:
        """As `acquire_lock`."""
        return await asyncio.to_thread(self.acquire_lock, key, holder, acquire_timeout, hold_timeout)

    def release_lock(self, key: str, holder: str) -> None:
        """Give the lock back.

        Raises:
            ValueError: this holder does not have it.
        """
        with self._mutex:
            if self._held.get(key, ("", 0))[0] != holder:
                raise ValueError(f"{holder} does not hold the lock of {key}")
            os.close(self._held.pop(key)[1])

    def is_locked(self, key: str) -> bool:
        """Whether anybody holds the lock, in this process or another."""
        with self._mutex:
            if key in self._held:
                return True
            try:
                handle = os.open(self._path(key), os.O_RDWR | os.O_CLOEXEC)
            except FileNotFoundError:
                return False
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                return True
            else:
                return False
            finally:
                os.close(handle)

    def is_lock_holder(self, key: str, holder: str) -> bool:
        """Whether this holder has the lock."""
        with self._mutex:
            return self._held.get(key, ("", 0))[0] == holder

    def wait_for_lock(self, key: str, timeout: float | None = None) -> bool:
        """Wait until nobody holds the lock; false after `timeout` seconds."""
        start = time.monotonic()
        while self.is_locked(key):
            if timeout is not None and time.monotonic() - start >= timeout:
                return False
            time.sleep(POLL_S)
        return True

    async def await_for_lock(self, key: str, timeout: float | None = None) -> bool:
        """As `wait_for_lock`."""
        return await asyncio.to_thread(self.wait_for_lock, key, timeout)

    def _path(self, key: str) -> Path:
        return self.folder / (hashlib.sha256(key.encode()).hexdigest() + ".lock")
