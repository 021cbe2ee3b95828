"""Linear map with few nonzero coefficients, whose gradient is the same in every run."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy.sparse import csr_array
from torch import Tensor


class SparseMap:
    """Weighted sums of some rows of a table.

    The gradient of indexing adds in any order, and a dense matrix takes several times as long; on a GPU it is dense.
    """

    def __init__(self, indices: Int[Tensor, "n k"], weights: Float[Tensor, "n k"], rows: int) -> None:
        """Store the sums.

        Args:
            indices: of the rows in each sum, different ones.
            weights: of these rows.
            rows: of the table.
        """
        count, terms = indices.shape
        self._dense: Tensor | None = None
        self._matrix: csr_array | None = None
        if weights.is_cuda:
            self._dense = weights.new_zeros(count, rows).scatter_(1, indices, weights)
            return
        starts = np.arange(count + 1) * terms
        arrays = weights.numpy(force=True).ravel(), indices.numpy(force=True).ravel(), starts
        self._matrix = csr_array(arrays, shape=(count, rows))
        self._transposed = csr_array(self._matrix.T)

    def __call__(self, values: Float[Tensor, "t m c"]) -> Float[Tensor, "t n c"]:
        """Return the sums of every table."""
        if self._dense is not None:
            return self._dense @ values
        sums: Tensor = _Product.apply(values, self._matrix, self._transposed)
        return sums


class _Product(torch.autograd.Function):
    """Product of a sparse matrix with every table, on the processor."""

    @staticmethod
    def forward(ctx: Any, values: Float[Tensor, "t m c"], matrix: csr_array, transposed: csr_array) -> Tensor:
        ctx.transposed = transposed
        return torch.from_numpy(_products(matrix, values.numpy(force=True)))

    @staticmethod
    def backward(ctx: Any, gradient: Float[Tensor, "t n c"]) -> tuple[Tensor, None, None]:
        return torch.from_numpy(_products(ctx.transposed, gradient.numpy(force=True))), None, None


def _products(matrix: csr_array, tables: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    products = [matrix @ table for table in tables]
    return np.stack(products) if products else np.empty((0, matrix.shape[0], tables.shape[2]), tables.dtype)
