"""Sparse linear systems over the pixels of a mask."""

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy import sparse
from scipy.sparse.linalg import splu


def neighbor_pairs(
    mask: Bool[np.ndarray, "h w"],
) -> tuple[Int64[np.ndarray, " pairs"], Int64[np.ndarray, " pairs"]]:
    """Return every two pixels of the mask that share a side, as indices into the mask's pixels in row order."""
    index = np.cumsum(mask.ravel()).reshape(mask.shape) - 1
    across, down = mask[:, :-1] & mask[:, 1:], mask[:-1] & mask[1:]
    first = np.concatenate([index[:, :-1][across], index[:-1][down]])
    second = np.concatenate([index[:, 1:][across], index[1:][down]])
    return first, second


def neighbor_counts(mask: Bool[np.ndarray, "h w"]) -> Float64[np.ndarray, " n"]:
    """Count the neighbors in the mask of each of its n pixels."""
    ends = np.concatenate(neighbor_pairs(mask))
    return np.bincount(ends, minlength=int(mask.sum())).astype(np.float64)


def solve_on_grid(
    mask: Bool[np.ndarray, "h w"], diagonal: Float64[np.ndarray, " n"], right: Float64[np.ndarray, "n *c"]
) -> Float64[np.ndarray, "n *c"]:
    """Solve `diagonal_i x_i - sum of x over the neighbors of i in the mask = right_i`.

    Args:
        mask: n pixels.
        diagonal: at least the number of neighbors in the mask, somewhat more in some place of each part.
        right: one or several right sides.
    """
    first, second = neighbor_pairs(mask)
    n = len(diagonal)
    rows = np.concatenate([first, second, np.arange(n)])
    columns = np.concatenate([second, first, np.arange(n)])
    values = np.concatenate([np.full(2 * len(first), -1.0), diagonal])
    matrix = sparse.csc_matrix((values, (rows, columns)), shape=(n, n))
    factors = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return factors.solve(right)
