"""Normal equations of a Gauss-Newton step over control nodes, six unknowns each, summed up in place.

With some hundred nodes the matrix is dense; a sparse Jacobian and its product would take half of the time of a step.
"""

from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cho_factor, cho_solve

from dg4d_lib.kernels.compiling import njit

UNKNOWNS = 6  # of a node: rotation vector and translation
DAMPING = 1e-9  # added to the diagonal, for nodes that no residual depends on


class NormalEquations:
    """Normal equations J^T J x = -J^T r of residuals r whose derivatives J are blocks of six columns."""

    def __init__(self, count: int) -> None:
        """Begin with no residuals for `count` nodes."""
        self._matrix = DAMPING * np.eye(UNKNOWNS * count)  # its upper triangle is not read
        self._right = np.zeros(UNKNOWNS * count)

    def add(
        self, blocks: Float[np.ndarray, "n k d 6"], nodes: Int[np.ndarray, "n k"], residuals: Float[np.ndarray, "n d"]
    ) -> None:
        """Add `n` items of `d` residuals each.

        Args:
            blocks: derivatives of every item's residuals by the unknowns of `k` nodes.
            nodes: these nodes; one that is named twice has the sum of both blocks.
            residuals: values.
        """
        given = (np.ascontiguousarray(blocks), np.ascontiguousarray(nodes), np.ascontiguousarray(residuals))
        _add(*given, self._matrix, self._right)

    def add_sum(self, unknown: int, slope: float, residual: float) -> None:
        """Add one residual that depends on the same unknown (0 to 5) of all nodes, with one derivative."""
        self._matrix[unknown::UNKNOWNS, unknown::UNKNOWNS] += slope**2
        self._right[unknown::UNKNOWNS] += slope * residual

    def solve(self) -> Float[np.ndarray, "m 6"]:
        """Return the step of the unknowns; this overwrites the matrix, so call it once.

        Raises:
            ValueError: derivatives or residuals are not finite.
        """
        # LAPACK works in place on columns: the lower triangle of the rows is the upper one of the columns
        factors = cho_factor(self._matrix.T, lower=False, overwrite_a=True, check_finite=False)
        step: Float[np.ndarray, "m 6"] = cho_solve(factors, -self._right).reshape(-1, UNKNOWNS)
        return step


@njit(cache=True, nogil=True)
@no_type_check
def _add(blocks, nodes, residuals, matrix, right):
    """Add items to the lower triangle of the matrix and to the right side."""
    items, count, height = blocks.shape[:3]
    for item in range(items):
        for first in range(count):
            row = UNKNOWNS * nodes[item, first]
            for d in range(height):
                for i in range(UNKNOWNS):
                    slope = blocks[item, first, d, i]
                    if slope == 0:
                        continue
                    right[row + i] += slope * residuals[item, d]
                    for second in range(count):
                        column = UNKNOWNS * nodes[item, second]
                        if column <= row:
                            for j in range(UNKNOWNS):
                                matrix[row + i, column + j] += slope * blocks[item, second, d, j]
