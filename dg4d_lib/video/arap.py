"""As-rigid-as-possible deformation of a 2D mesh (Igarashi et al. 2005; Sorkine and Alexa 2007)."""

import numpy as np
from jaxtyping import Complex128, Float64, Int64
from scipy import sparse
from scipy.sparse.linalg import splu

ITERATIONS = 15


class ArapMesh:
    """2D mesh that is posed by handle nodes; the other nodes follow with minimal stretching."""

    def __init__(
        self, nodes: Float64[np.ndarray, "n 2"], edges: Int64[np.ndarray, "e 2"], handles: Int64[np.ndarray, " k"]
    ) -> None:
        """Factorize the linear system once for all poses of these handles.

        Args:
            nodes: rest positions.
            edges: each edge once.
            handles: indices of the handle nodes, at least one per connected component.
        """
        self._rest = nodes @ np.array([1, 1j])  # points as complex numbers, so that a rotation is a product
        self._edges, self._handles = edges, handles
        n = len(nodes)
        ones = np.ones(len(edges))
        links = sparse.csr_matrix((ones, (edges[:, 0], edges[:, 1])), shape=(n, n))
        links = links + links.T
        laplacian = (sparse.diags(np.asarray(links.sum(1)).ravel()) - links).tocsr()
        self._free = np.setdiff1d(np.arange(n), handles)
        self._coupling = laplacian[self._free][:, handles]
        self._factors = splu(laplacian[self._free][:, self._free].tocsc(), permc_spec="MMD_AT_PLUS_A")

    def pose(self, targets: Float64[np.ndarray, "k 2"]) -> Float64[np.ndarray, "n 2"]:
        """Return the positions of all nodes with the handles at `targets`."""
        start, end = self._edges.T
        rest = self._rest[start] - self._rest[end]
        positions = self._rest.copy()
        positions[self._handles] = targets @ np.array([1, 1j])
        for _ in range(ITERATIONS):
            covariances = (positions[start] - positions[end]) * rest.conj()
            rotations = self._sum_at_nodes(covariances, covariances)
            rotations /= np.maximum(np.abs(rotations), 1e-12)
            rotated = 0.5 * (rotations[start] + rotations[end]) * rest
            right = self._sum_at_nodes(rotated, -rotated)[self._free] - self._coupling @ positions[self._handles]
            positions[self._free] = self._factors.solve(np.stack([right.real, right.imag], -1)) @ np.array([1, 1j])
        return np.stack([positions.real, positions.imag], -1)

    def _sum_at_nodes(
        self, at_start: Complex128[np.ndarray, " e"], at_end: Complex128[np.ndarray, " e"]
    ) -> Complex128[np.ndarray, " n"]:
        """Sum values of the edges at every node."""
        ends, values = self._edges.T.ravel(), np.concatenate([at_start, at_end])
        n = len(self._rest)
        return np.bincount(ends, values.real, n) + 1j * np.bincount(ends, values.imag, n)
