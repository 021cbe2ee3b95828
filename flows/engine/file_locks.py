"""Locks on the records of results between the processes of one host; Prefect's own lock files outlive their process."""

import asyncio
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

POLL_S = 0.1  # between two attempts to take a lock


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
