"""Neighborhoods of vertices on a triangle mesh."""

import numpy as np
from jaxtyping import Bool, Int
from scipy.sparse import coo_array, csr_array


def edge_graph(faces: Int[np.ndarray, "f 3"], count: int) -> csr_array:
    """Return the adjacency of the vertices: 1 where two share an edge."""
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.unique(np.sort(sides, 1), axis=0)
    rows, columns = np.concatenate([edges, edges[:, ::-1]]).T
    return coo_array((np.ones(2 * len(edges)), (rows, columns)), shape=(count, count)).tocsr()


def faces_to_vertices(
    marked: Bool[np.ndarray, " f"], faces: Int[np.ndarray, "f 3"], count: int
) -> Bool[np.ndarray, " v"]:
    """Mark the corners of marked faces."""
    corners = np.zeros(count, bool)
    corners[faces[marked]] = True
    return corners


def grown(marked: Bool[np.ndarray, " v"], edges: csr_array, rings: int) -> Bool[np.ndarray, " v"]:
    """Mark the neighbors of marked vertices too, ring by ring."""
    for _ in range(rings):
        marked = marked | (edges @ marked.astype(np.float32) > 0)
    return marked
