"""Neighborhoods of vertices on a triangle mesh."""

import numpy as np
from jaxtyping import Bool, Float, Int, Int64
from scipy.sparse import coo_array, csc_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import SuperLU, splu


def half_edges(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "e 2"]:
    """Return the three directed edges of every face, face by face."""
    return np.stack([faces, np.roll(faces, -1, 1)], -1).reshape(-1, 2)


def mesh_edges(faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "e 2"]:
    """Return every edge once, its smaller index first, in ascending order."""
    edges = half_edges(faces)
    _, first = np.unique(edge_keys(edges), return_index=True)
    return np.sort(edges[first], 1)


def edge_keys(edges: Int[np.ndarray, "e 2"]) -> Int64[np.ndarray, " e"]:
    """Return a number for every edge, equal in both directions, in the order of smaller and then larger index.

    Numbers are sorted four times as fast as pairs.
    """
    wide = edges.astype(np.int64)
    return wide.min(1) * (wide.max(initial=0) + 1) + wide.max(1)


def twin_half_edges(edges: Int[np.ndarray, "e 2"]) -> Int[np.ndarray, "p 2"]:
    """Return pairs of half edges that meet: the only two between two vertices, in opposite directions."""
    keys = edge_keys(edges)
    order = np.argsort(keys, kind="stable")
    _, firsts, uses = np.unique(keys[order], return_index=True, return_counts=True)
    pairs = np.stack([order[firsts[uses == 2]], order[firsts[uses == 2] + 1]], 1)
    return pairs[edges[pairs[:, 0], 0] == edges[pairs[:, 1], 1]]


def edge_graph(faces: Int[np.ndarray, "f 3"], count: int) -> csr_array:
    """Return the adjacency of the vertices: 1 where two share an edge."""
    edges = mesh_edges(faces)
    rows, columns = np.concatenate([edges, edges[:, ::-1]]).T
    return coo_array((np.ones(2 * len(edges)), (rows, columns)), shape=(count, count)).tocsr()


def connected_parts(edges: csr_array, selected: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """Label every selected vertex by its connected component, using only edges between selected vertices."""
    labels: Int[np.ndarray, " n"] = connected_components(edges[selected][:, selected], directed=False)[1]
    return labels


def neighbor_means(edges: csr_array) -> csr_array:
    """Return the matrix that averages the neighbors of every vertex; rows of isolated vertices are 0."""
    return csr_array(diags_array(1 / np.maximum(edges.sum(axis=1), 1)) @ edges)


def graph_laplacian(edges: csr_array) -> csr_array:
    """Return the number of neighbors on the diagonal minus the adjacency."""
    return csr_array(diags_array(edges.sum(axis=1)) - edges)


def screened_factors(laplacian: csr_array, pull: Float[np.ndarray, " n"]) -> SuperLU:
    """Return the factors of a Laplacian plus the weights by which vertices are pulled to given values."""
    return splu(csc_array(laplacian + diags_array(pull)), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})


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
