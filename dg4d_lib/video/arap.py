"""As-rigid-as-possible deformation of a flat mesh (Igarashi et al. 2005; Sorkine and Alexa 2007)."""

import numpy as np
from jaxtyping import Complex128, Float64, Int64
from scipy import sparse
from scipy.sparse.linalg import splu

ITERATIONS = 15


class ArapMesh:
    """A mesh some of whose nodes are led; the others follow with as little stretching as possible."""

    def __init__(
        self, nodes: Float64[np.ndarray, "n 2"], edges: Int64[np.ndarray, "e 2"], led: Int64[np.ndarray, " k"]
    ) -> None:
        """Prepare for many poses of the same led nodes.

        Args:
            nodes: at rest.
            edges: each side once.
            led: which nodes are led, at least one in every connected part.
        """
        self._rest = nodes @ np.array([1, 1j])  # the plane as complex numbers: a rotation is a factor
        self._edges, self._led = edges, led
        n = len(nodes)
        ones = np.ones(len(edges))
        links = sparse.csr_matrix((ones, (edges[:, 0], edges[:, 1])), shape=(n, n))
        links = links + links.T
        laplacian = (sparse.diags(np.asarray(links.sum(1)).ravel()) - links).tocsr()
        self._free = np.setdiff1d(np.arange(n), led)
        self._pull = laplacian[self._free][:, led]
        self._factors = splu(laplacian[self._free][:, self._free].tocsc(), permc_spec="MMD_AT_PLUS_A")

    def pose(self, targets: Float64[np.ndarray, "k 2"]) -> Float64[np.ndarray, "n 2"]:
        """Where all nodes go when the led ones go to `targets`."""
        start, end = self._edges.T
        rest = self._rest[start] - self._rest[end]
        places = self._rest.copy()
        places[self._led] = targets @ np.array([1, 1j])
        for _ in range(ITERATIONS):
            turned = (places[start] - places[end]) * rest.conj()
            spin = self._gather(turned, turned)
            spin /= np.maximum(np.abs(spin), 1e-12)
            wanted = 0.5 * (spin[start] + spin[end]) * rest
            right = self._gather(wanted, -wanted)[self._free] - self._pull @ places[self._led]
            places[self._free] = self._factors.solve(np.stack([right.real, right.imag], -1)) @ np.array([1, 1j])
        return np.stack([places.real, places.imag], -1)

    def _gather(
        self, at_start: Complex128[np.ndarray, " e"], at_end: Complex128[np.ndarray, " e"]
    ) -> Complex128[np.ndarray, " n"]:
        """Sums over the edges at every node."""
        ends, values = self._edges.T.ravel(), np.concatenate([at_start, at_end])
        n = len(self._rest)
        return np.bincount(ends, values.real, n) + 1j * np.bincount(ends, values.imag, n)
