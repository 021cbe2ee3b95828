"""Thread pool and buffer pool of the kernels."""

import threading

import numpy as np
import pytest
import torch

from dg4d_lib.kernels.workers import (
    Scratch,
    empty_recycled,
    run_parallel,
    split_range,
    thread_count,
    torch_on_one_thread,
)


def test_ranges_cover_the_whole_at_multiples():
    assert split_range(10, 3) == [(0, 4), (4, 8), (8, 10)]
    assert split_range(0, 4) == []


@pytest.mark.parametrize("threads", [1, 3])
def test_every_job_runs_and_a_failure_is_raised(threads):
    before, done = torch.get_num_threads(), []
    torch.set_num_threads(threads)
    try:
        run_parallel([lambda i=i: done.append(i) for i in range(7)])
        with pytest.raises(ZeroDivisionError):
            run_parallel([lambda: 1 / 0, lambda: None])
    finally:
        torch.set_num_threads(before)
    assert sorted(done) == list(range(7))


def test_memory_is_used_again_but_never_while_in_use():
    first, second = Scratch(), Scratch()
    a, b = first.empty((1000, 3)), second.empty((3000,))
    assert not np.shares_memory(a, b)
    address = a.ctypes.data
    del a, first
    again = Scratch()
    assert again.empty((2999,)).ctypes.data == address
    assert again.empty((2, 2), np.bool_).dtype == np.bool_


def test_memory_of_a_recycled_array_waits_for_the_tensor_made_of_it():
    array = empty_recycled((1000, 3))
    array[:] = 1
    address, tensor = array.ctypes.data, torch.from_numpy(array)
    part = tensor[5:]
    del array, tensor
    assert empty_recycled((1000, 3)).ctypes.data != address
    assert part.eq(1).all()
    del part
    assert empty_recycled((1000, 3)).ctypes.data == address


def test_the_kernels_keep_their_threads_while_torch_has_one():
    before, seen = torch.get_num_threads(), []
    torch.set_num_threads(3)
    started = threading.Barrier(3)
    jobs = [lambda: seen.append((started.wait(10), torch.get_num_threads())[1])] * 3
    try:
        with torch_on_one_thread(), torch_on_one_thread():
            run_parallel(jobs)
            assert thread_count() == 3
        assert seen == [1, 1, 1]  # at once, by the barrier
        assert torch.get_num_threads() == thread_count() == 3
        run_parallel(jobs)
        assert seen[3:] == [3, 3, 3]  # in the pool's threads, too
    finally:
        torch.set_num_threads(before)
