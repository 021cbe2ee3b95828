"""Screened Laplace systems on a mesh, solved iteratively from an initial guess."""

from typing import no_type_check

import numpy as np
from jaxtyping import Float, Float64
from scipy.sparse import csr_array

from dg4d_lib.kernels.compiling import njit

TOLERANCE = 1e-4  # of the right-hand side, in the norm of the preconditioner; leaves less than 0.01 pixels
ITERATIONS = 500  # largest number; with pulls of 0.05 and more, tens are enough


def solve_screened(
    edges: csr_array, pull: Float[np.ndarray, " v"], wanted: Float[np.ndarray, "v 3"], start: Float[np.ndarray, "v 3"]
) -> Float64[np.ndarray, "v 3"]:
    """Return the solution x of (L + pull) x = wanted, for the graph Laplacian L, by conjugate gradients.

    With pulls of 0.5 and more, this takes a tenth of the time of a factorization.

    Args:
        edges: adjacency of the vertices.
        pull: weight by which every vertex is pulled, against 1 for each of its edges; above 0.
        wanted: right-hand side.
        start: guess of the solution.
    """
    solution = start.astype(np.float64)
    _iterate(edges.indptr, edges.indices, pull.astype(np.float64), wanted.astype(np.float64), solution)
    return solution


@njit(cache=True, nogil=True)
@no_type_check
def _iterate(starts, neighbors, pull, wanted, solution):
    """Improve the solution until every column is exact to `TOLERANCE`; the diagonal is the preconditioner."""
    count, columns = solution.shape
    diagonal = pull + (starts[1:] - starts[:-1])
    direction, image = np.empty_like(solution), np.empty_like(solution)
    residual = np.empty_like(solution)
    enough, size = np.zeros(columns), np.zeros(columns)
    _apply(starts, neighbors, diagonal, solution, image)
    for v in range(count):
        for c in range(columns):
            residual[v, c] = wanted[v, c] - image[v, c]
            direction[v, c] = residual[v, c] / diagonal[v]
            size[c] += residual[v, c] * direction[v, c]
            enough[c] += TOLERANCE**2 * wanted[v, c] ** 2 / diagonal[v]
    step, before = np.zeros(columns), np.empty(columns)
    for _ in range(ITERATIONS):
        if (size <= enough).all():
            break
        _apply(starts, neighbors, diagonal, direction, image)
        step[:] = 0
        for v in range(count):
            for c in range(columns):
                step[c] += direction[v, c] * image[v, c]
        for c in range(columns):
            step[c] = size[c] / step[c] if step[c] > 0 else 0.0
            before[c], size[c] = size[c], 0
        for v in range(count):
            for c in range(columns):
                solution[v, c] += step[c] * direction[v, c]
                residual[v, c] -= step[c] * image[v, c]
                size[c] += residual[v, c] ** 2 / diagonal[v]
        for v in range(count):
            for c in range(columns):
                kept = size[c] / before[c] if before[c] > 0 else 0.0
                direction[v, c] = residual[v, c] / diagonal[v] + kept * direction[v, c]


@njit(cache=True, nogil=True)
@no_type_check
def _apply(starts, neighbors, diagonal, values, image):
    """Write the product of the system with the values."""
    for v in range(len(diagonal)):
        for c in range(values.shape[1]):
            image[v, c] = diagonal[v] * values[v, c]
        for k in range(starts[v], starts[v + 1]):
            for c in range(values.shape[1]):
                image[v, c] -= values[neighbors[k], c]
