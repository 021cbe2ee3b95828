"""Micro-batching within a memory budget, with smaller batches after an out-of-memory error."""

from collections.abc import Callable
from typing import TypeVar

import torch

from dg4d_lib.errors import BackendUnavailable, is_out_of_memory

Result = TypeVar("Result")


class MicroBatches:
    """Runner of a function over micro-batches; a micro-batch that runs out of memory is halved and repeated.

    The smaller size is kept for all later calls.

    Attributes:
        size: largest number of items of a micro-batch.
    """

    def __init__(self, name: str, size: int) -> None:
        """Set the initial size.

        Args:
            name: of the items, for notes: "views of the prior".
            size: number of items; at least 1.
        """
        self.name, self.size = name, max(1, size)
        self._halved_from: int | None = None

    @classmethod
    def within(cls, name: str, memory_gb: float, resident_gb: float, item_gb: float) -> "MicroBatches":
        """Return micro-batches of as many items as fit into a memory budget, at least one.

        Args:
            name: of the items.
            memory_gb: budget, GiB.
            resident_gb: memory in use without items: weights and the rest of the process, GiB.
            item_gb: memory per item, GiB.
        """
        return cls(name, int((memory_gb - resident_gb) / item_gb))

    def run(self, function: Callable[[slice], Result], total: int, most: int | None = None) -> list[Result]:
        """Return the results of `function` for consecutive slices of `range(total)`, in order.

        Args:
            function: without side effects: it is called again after a slice ran out of memory.
            total: number of items.
            most: additional bound on the size, for items that are larger than others; at least 1.

        Raises:
            BackendUnavailable: a single item does not fit into memory.
        """
        results: list[Result] = []
        start = 0
        while start < total:
            piece = slice(start, min(start + min(self.size, most or self.size), total))
            try:
                results.append(function(piece))
            except RuntimeError as error:
                if not is_out_of_memory(error):
                    raise
            else:
                start = piece.stop
                continue
            self._halve(piece.stop - piece.start)  # outside of `except`, so that the traceback no longer holds tensors
        return results

    def notes(self) -> tuple[str, ...]:
        """Return a sentence for the report if memory ran out, else nothing."""
        if self._halved_from is None:
            return ()
        return (
            f"memory ran out with {self._halved_from} {self.name} at once; continued with at most {self.size}; "
            "lower memory_gb to avoid the failed attempts",
        )

    def _halve(self, tried: int) -> None:
        if tried == 1:
            raise BackendUnavailable(
                f"not enough memory for one of the {self.name}; close other programs that use the device, or choose a "
                "lower precision"
            )
        self._halved_from = self._halved_from or tried
        self.size = tried // 2
        if torch.cuda.is_available():
            torch.cuda.empty_cache()
