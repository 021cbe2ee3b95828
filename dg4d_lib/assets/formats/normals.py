"""Smooth vertex normals across texture seams."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from dg4d_lib.mesh.extraction.topology import group_vertices


class SmoothNormals:
    """Area-weighted unit normals of a mesh in any pose.

    Vertices at equal rest positions, the copies along texture seams, get equal normals.
    """

    def __init__(self, rest: NDArray[np.float32], faces: NDArray[np.integer[Any]]) -> None:
        points, self._point_of = group_vertices(rest)
        self._faces = faces
        corners = (self._point_of[faces].ravel(), np.repeat(np.arange(len(faces)), 3))
        self._faces_around = csr_array((np.ones(faces.size), corners), shape=(len(points), len(faces)))

    def __call__(self, vertices: NDArray[np.float32]) -> NDArray[np.float32]:
        """Compute the normals of a pose; +y for vertices without triangles or with degenerate ones only."""
        a, b, c = (vertices[self._faces[:, corner]].astype(np.float64) for corner in range(3))
        sums = np.asarray(self._faces_around @ np.cross(b - a, c - a))
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        unit = np.where(lengths > 0, sums / np.maximum(lengths, np.finfo(np.float64).tiny), (0.0, 1.0, 0.0))
        return unit[self._point_of].astype(np.float32)
