import pytest
import torch

from dg4d_lib.diffusion.batching import MicroBatches
from dg4d_lib.errors import BackendUnavailable


class Memory:
    """Function with room for a number of items that records accepted and refused slices."""

    def __init__(self, room: int, error: RuntimeError | None = None) -> None:
        self.room, self.error = room, error or torch.OutOfMemoryError("simulated")
        self.done: list[tuple[int, int]] = []
        self.refused: list[int] = []

    def __call__(self, piece: slice) -> list[int]:
        if piece.stop - piece.start > self.room:
            self.refused.append(piece.stop - piece.start)
            raise self.error
        self.done.append((piece.start, piece.stop))
        return list(range(piece.start, piece.stop))


@pytest.mark.parametrize(("total", "size"), [(56, 56), (56, 24), (7, 3), (1, 8), (0, 4)])
def test_every_item_goes_through_once_and_in_order(total: int, size: int) -> None:
    memory = Memory(size)
    results = MicroBatches("views", size).run(memory, total)
    assert [item for result in results for item in result] == list(range(total))
    assert len(results) == -(-total // size) and not memory.refused


def test_a_piece_that_does_not_fit_is_halved_and_the_rest_goes_on_so() -> None:
    batches, memory = MicroBatches("views", 12), Memory(5)
    results = batches.run(memory, 14)
    assert [item for result in results for item in result] == list(range(14))
    assert memory.refused == [12, 6]
    assert memory.done == [(0, 3), (3, 6), (6, 9), (9, 12), (12, 14)]
    assert batches.size == 3


def test_the_smaller_size_is_remembered_and_reported() -> None:
    batches = MicroBatches("views", 12)
    batches.run(Memory(12), 24)
    assert batches.notes() == ()
    batches.run(Memory(5), 14)
    later = Memory(5)
    batches.run(later, 9)
    assert not later.refused
    (note,) = batches.notes()
    assert "12 views" in note and "at most 3" in note


def test_a_failure_in_the_middle_repeats_nothing_that_was_done() -> None:
    room = {0: 4, 4: 1, 5: 1, 6: 1}
    seen = []

    def function(piece: slice) -> int:
        if piece.stop - piece.start > room[piece.start]:
            raise torch.OutOfMemoryError("simulated")
        seen.append(piece.start)
        return piece.start

    assert MicroBatches("views", 4).run(function, 7) == [0, 4, 5, 6]
    assert seen == [0, 4, 5, 6]


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes"),
        RuntimeError("CUDA error: CUBLAS_STATUS_ALLOC_FAILED when calling `cublasCreate(handle)`"),
        RuntimeError("cuDNN error: CUDNN_STATUS_ALLOC_FAILED"),
        torch.AcceleratorError("CUDA error: out of memory"),
    ],
)
def test_memory_that_ran_out_outside_of_the_allocator_of_torch_counts_too(error: RuntimeError) -> None:
    batches = MicroBatches("views", 4)
    assert len(batches.run(Memory(2, error), 4)) == 2


def test_other_errors_are_not_swallowed() -> None:
    memory = Memory(1, RuntimeError("shapes differ"))
    with pytest.raises(RuntimeError, match="shapes differ"):
        MicroBatches("views", 4).run(memory, 4)
    assert memory.refused == [4]


def test_no_room_for_a_single_item_is_the_end() -> None:
    with pytest.raises(BackendUnavailable, match="one of the views"):
        MicroBatches("views", 4).run(Memory(0), 4)


def test_a_budget_says_how_many() -> None:
    assert [MicroBatches.within("views", gb, 5.0, 0.5).size for gb in (12, 24, 80)] == [14, 38, 150]
    assert MicroBatches.within("views", 4, 5.0, 0.5).size == 1
