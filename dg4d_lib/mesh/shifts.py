"""Grids and shifted copies of themselves."""

from collections.abc import Sequence

Slices = tuple[slice, ...]


def shifted(shift: Sequence[int]) -> tuple[Slices, Slices]:
    """Return the places of a grid that a shift of its samples covers, and the places that these samples come from.

    Args:
        shift: number of samples along each axis.
    """
    onto = tuple(slice(max(step, 0), min(step, 0) or None) for step in shift)
    return onto, tuple(slice(max(-step, 0), -max(step, 0) or None) for step in shift)
