"""Smooth normals that know nothing of texture seams."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array


class SmoothNormals:
    """Unit normals of one topology in any pose, weighted by area.

    Equal at vertices that lie at the same place at rest: the copies along texture seams.
    """

    def __init__(self, rest: NDArray[np.float32], faces: NDArray[np.integer[Any]]) -> None:
        places, place_of = np.unique(rest, axis=0, return_inverse=True)
        self._faces, self._place_of = faces, place_of.ravel()
        corners = (self._place_of[faces].ravel(), np.repeat(np.arange(len(faces)), 3))
        self._faces_around = csr_array((np.ones(faces.size), corners), shape=(len(places), len(faces)))

    def __call__(self, vertices: NDArray[np.float32]) -> NDArray[np.float32]:
        """Normals of a pose. A vertex of no triangle, or of triangles without area, gets +y."""
        a, b, c = (vertices[self._faces[:, corner]].astype(np.float64) for corner in range(3))
        sums = np.asarray(self._faces_around @ np.cross(b - a, c - a))
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        unit = np.where(lengths > 0, sums / np.maximum(lengths, np.finfo(np.float64).tiny), (0.0, 1.0, 0.0))
        return unit[self._place_of].astype(np.float32)
