"""Random choices of the shape generator."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

T = TypeVar("T")


class Chance:
    """A seeded source of the draws that shapes are made of."""

    def __init__(self, seed: int | Sequence[int]) -> None:
        self.generator = np.random.default_rng(seed)

    def between(self, low: float, high: float) -> float:
        """Return a number drawn evenly from an interval."""
        return low + (high - low) * self.generator.random()

    def normal(self, sigma: float, mean: float = 0.0) -> float:
        """Return a number from a normal distribution, cut at 2.5 sigma."""
        return mean + sigma * float(np.clip(self.generator.standard_normal(), -2.5, 2.5))

    def happens(self, probability: float) -> bool:
        """Return True with a probability."""
        return bool(self.generator.random() < probability)

    def integer(self, low: int, high: int) -> int:
        """Return a whole number from low to high, both included."""
        return int(self.generator.integers(low, high + 1))

    def sign(self) -> float:
        """Return -1 or 1."""
        return 1.0 if self.happens(0.5) else -1.0

    def pick(self, choices: Sequence[T], weights: Sequence[float] | None = None) -> T:
        """Return one of several things, with weights that need not sum to 1."""
        if weights is None:
            return choices[self.integer(0, len(choices) - 1)]
        at = self.between(0, sum(weights))
        for choice, weight in zip(choices, weights, strict=True):
            at -= weight
            if at < 0:
                return choice
        return choices[-1]
