"""Thread pool and buffer pool of the Numba kernels.

Kernels release the GIL, so ordinary threads are enough; there are `thread_count()` of them, idle between calls. Buffers
are reused because the page faults of freshly allocated megabytes cost more than the blending itself.
"""

import os
import weakref
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from math import prod
from typing import Any

import numpy as np
import torch
from numpy.typing import DTypeLike, NDArray

_IDLE: defaultdict[int, list[NDArray[np.uint8]]] = defaultdict(list)  # free buffers by size in bytes
_MAX_IDLE_BYTES = 1 << 29
_kept_count = 0  # threads of the kernels while torch has one; 0: as torch


def thread_count() -> int:
    """Return the number of threads of the kernels: that of torch, or in `torch_on_one_thread` its earlier value."""
    return _kept_count or torch.get_num_threads()


@contextmanager
def torch_on_one_thread() -> Iterator[None]:
    """Keep the kernels on all threads and torch's own operators on one: for small ones, waking its threads costs more.

    Their sums then also have one order, whatever the number of threads.
    """
    global _kept_count  # noqa: PLW0603 - of the process, as the number of torch
    outside, threads = _kept_count, torch.get_num_threads()
    _kept_count = thread_count()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        _kept_count = outside


def run_parallel(jobs: Sequence[Callable[[], object]]) -> None:
    """Run independent jobs on this thread and the pool, wait for all, and re-raise the exception of a failed one."""
    queue = iter(jobs)  # shared by the threads without a lock: advancing a list iterator is atomic under the GIL
    count = torch.get_num_threads()

    def work() -> None:
        for job in queue:
            job()

    def help_out() -> None:
        if torch.get_num_threads() != count:  # every thread has its own number and keeps it for later calls
            torch.set_num_threads(count)
        work()

    helpers = min(thread_count(), len(jobs)) - 1
    futures = [_pool(os.getpid(), helpers).submit(help_out) for _ in range(helpers)]
    try:
        work()
    finally:
        for future in futures:
            if not future.cancel():  # a helper that has not started has nothing left to do
                future.result()


def split_range(count: int, parts: int) -> list[tuple[int, int]]:
    """Split range(count) into about `parts` consecutive ranges."""
    step = max(1, -(-count // max(parts, 1)))
    return [(start, min(start + step, count)) for start in range(0, count, step)]


@cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """Return the pool of a process (threads do not survive a fork) and a number of threads."""
    return ThreadPoolExecutor(threads, thread_name_prefix="kernels")


class Scratch:
    """Scratch arrays of one call; their buffers return to the pool when this object is garbage-collected."""

    def __init__(self) -> None:
        self._buffers: list[NDArray[np.uint8]] = []
        weakref.finalize(self, _release, self._buffers).atexit = False

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike = np.float32) -> NDArray[Any]:
        """Return an uninitialized array."""
        buffer, array = _acquire(shape, dtype)
        self._buffers.append(buffer)
        return array


def empty_recycled(shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return an uninitialized array whose buffer returns to the pool with the last reference to the array.

    A tensor from `torch.from_numpy` holds such a reference; NumPy views do not and must not outlive the array.
    """
    buffer, array = _acquire(shape, np.float32)
    weakref.finalize(array, _release, [buffer]).atexit = False
    return array


def _acquire(shape: tuple[int, ...], dtype: DTypeLike) -> tuple[NDArray[np.uint8], NDArray[Any]]:
    """Take a buffer from the pool and return it with an array in it."""
    bytes_needed = prod(shape) * np.dtype(dtype).itemsize
    size = 1 << max(12, (bytes_needed - 1).bit_length())
    try:
        buffer = _IDLE[size].pop()
    except IndexError:
        buffer = np.empty(size, np.uint8)
    return buffer, buffer[:bytes_needed].view(dtype).reshape(shape)


def _release(buffers: list[NDArray[np.uint8]]) -> None:
    idle = sum(size * len(free) for size, free in list(_IDLE.items()))
    for buffer in buffers:
        idle += buffer.size
        if idle <= _MAX_IDLE_BYTES:
            _IDLE[buffer.size].append(buffer)
