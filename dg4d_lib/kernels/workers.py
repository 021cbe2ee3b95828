"""Threads that run kernels, and memory that kernels use again.

Kernels release the interpreter's lock, so plain threads do; they sleep between calls. Their number is
`torch.get_num_threads()`. Fresh arrays of megabytes would cost more in page faults than blending them.
"""

import os
import weakref
from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from math import prod
from typing import Any

import numpy as np
import torch
from numpy.typing import DTypeLike, NDArray

_IDLE: defaultdict[int, list[NDArray[np.uint8]]] = defaultdict(list)  # memory that is free, by size
_IDLE_BYTES = 1 << 29  # of it at most


def run(jobs: Sequence[Callable[[], None]]) -> None:
    """Run independent jobs, here and on other threads, and wait for all; raises what a failing one raised."""
    waiting = iter(jobs)  # that threads take from it in turn needs no lock: its step is one of the interpreter's

    def work() -> None:
        for job in waiting:
            job()

    helpers = min(torch.get_num_threads(), len(jobs)) - 1
    helping = [_pool(os.getpid(), helpers).submit(work) for _ in range(helpers)]
    try:
        work()
    finally:
        for helper in helping:
            if not helper.cancel():  # one that did not start has nothing left to do
                helper.result()


def ranges(count: int, parts: int, multiple: int = 1) -> list[tuple[int, int]]:
    """About `parts` consecutive ranges that make up 0..count, their bounds at multiples."""
    step = max(1, -(-count // max(parts, 1) // multiple)) * multiple
    return [(start, min(start + step, count)) for start in range(0, count, step)]


@cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """One pool per process (threads do not survive a fork) and number of helpers."""
    return ThreadPoolExecutor(threads, thread_name_prefix="kernels")


class Scratch:
    """Arrays for one call; their memory goes back to a common store when this object is no longer used."""

    def __init__(self) -> None:
        self._taken: list[NDArray[np.uint8]] = []
        weakref.finalize(self, _give_back, self._taken).atexit = False

    def empty(self, shape: tuple[int, ...], dtype: DTypeLike = np.float32) -> NDArray[Any]:
        """An array with arbitrary content."""
        memory, array = _take(shape, dtype)
        self._taken.append(memory)
        return array


def recycled(shape: tuple[int, ...]) -> NDArray[np.float32]:
    """An array with arbitrary content; its memory goes back when neither it nor a tensor made of it is used any more.

    Its views do not count: they have to go first.
    """
    memory, array = _take(shape, np.float32)
    weakref.finalize(array, _give_back, [memory]).atexit = False
    return array


def _take(shape: tuple[int, ...], dtype: DTypeLike) -> tuple[NDArray[np.uint8], NDArray[Any]]:
    """Memory from the store, and an array in it."""
    bytes_needed = prod(shape) * np.dtype(dtype).itemsize
    size = 1 << max(12, (bytes_needed - 1).bit_length())
    try:
        memory = _IDLE[size].pop()
    except IndexError:
        memory = np.empty(size, np.uint8)
    return memory, memory[:bytes_needed].view(dtype).reshape(shape)


def _give_back(taken: list[NDArray[np.uint8]]) -> None:
    idle = sum(size * len(arrays) for size, arrays in list(_IDLE.items()))
    for memory in taken:
        idle += memory.size
        if idle <= _IDLE_BYTES:
            _IDLE[memory.size].append(memory)
