"""How much goes through a large network at once: what a memory budget allows, and less when that was too much."""

from collections.abc import Callable
from typing import TypeVar

import torch

from dg4d_lib.errors import BackendUnavailable

Result = TypeVar("Result")


class MicroBatches:
    """Runs a function over a batch in pieces; a piece that does not fit into memory is halved and done again.

    The smaller size is kept for everything that follows.

    Attributes:
        size: the most items of a piece.
    """

    def __init__(self, name: str, size: int) -> None:
        """Begin with a size.

        Args:
            name: what goes through, for notes: "views of the prior".
            size: at least 1.
        """
        self.name, self.size = name, max(1, size)
        self._halved_from: int | None = None

    @classmethod
    def within(cls, name: str, memory_gb: float, resident_gb: float, item_gb: float) -> "MicroBatches":
        """As many items as a budget has room for, at least one.

        Args:
            name: as above.
            memory_gb: the budget, GiB.
            resident_gb: of it, what is taken before the first item: weights and everything else of the process.
            item_gb: what one item takes while it goes through.
        """
        return cls(name, int((memory_gb - resident_gb) / item_gb))

    def run(self, function: Callable[[slice], Result], total: int, most: int | None = None) -> list[Result]:
        """What `function` returns for consecutive slices of `range(total)`, in order.

        Args:
            function: may be called for a slice again after it ran out of memory, so it must change nothing outside.
            total: how many items there are.
            most: of a piece of these items, where they are larger than others; at least 1.

        Raises:
            BackendUnavailable: there is no memory for a single item.
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
            self._halve(piece.stop - piece.start)  # here the error, and what its frames held, is gone
        return results

    def notes(self) -> tuple[str, ...]:
        """A sentence for the report if memory ran out; nothing if it never did."""
        if self._halved_from is None:
            return ()
        return (
            f"memory ran out with {self._halved_from} {self.name} at once; the rest was done with at most {self.size}; "
            "a lower memory_gb avoids the attempt",
        )

    def _halve(self, tried: int) -> None:
        if tried == 1:
            raise BackendUnavailable(
                f"there is not enough memory for one of the {self.name}; close what else uses the device, or choose a "
                "lower precision"
            )
        self._halved_from = self._halved_from or tried
        self.size = tried // 2
        if torch.cuda.is_available():
            torch.cuda.empty_cache()


def is_out_of_memory(error: RuntimeError) -> bool:
    """Whether torch could not get memory, on a GPU or for the processor."""
    return isinstance(error, torch.OutOfMemoryError) or "can't allocate memory" in str(error)
