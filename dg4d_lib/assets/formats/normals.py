"""Vertex normals of a mesh in any pose, smooth across texture seams.

Copies of a vertex share a normal within a smoothing group of the mesh, except where surfaces only touch: those that
part in another pose have normals of their own from the start.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy.sparse import csr_array

from dg4d_lib.mesh.extraction.topology import face_components, group_labels, group_vertices
from dg4d_lib.mesh.textured import TexturedMesh


class SmoothNormals:
    """Area-weighted unit normals of a mesh in any pose, equal for the vertices of a group."""

    def __init__(self, groups: NDArray[np.integer[Any]], faces: NDArray[np.integer[Any]]) -> None:
        """Prepare the normals.

        Args:
            groups: number of the group of every vertex, from 0 without gaps.
            faces: indices into the vertices.
        """
        self._groups, self._faces = groups, faces
        corners = (groups[faces].ravel(), np.repeat(np.arange(len(faces)), 3))
        self._faces_around = csr_array((np.ones(faces.size), corners), shape=(groups.max() + 1, len(faces)))

    def __call__(self, vertices: NDArray[np.float32]) -> NDArray[np.float32]:
        """Compute the normals of a pose; +y for vertices without triangles or with degenerate ones only."""
        a, b, c = (vertices[self._faces[:, corner]].astype(np.float64) for corner in range(3))
        sums = np.asarray(self._faces_around @ np.cross(b - a, c - a))
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        unit = np.where(lengths > 0, sums / np.maximum(lengths, np.finfo(np.float64).tiny), (0.0, 1.0, 0.0))
        return unit[self._groups].astype(np.float32)


def mesh_normal_groups(mesh: TexturedMesh, states: Float[np.ndarray, "t v 3"]) -> Int[np.ndarray, " v"]:
    """Return the `normal_groups` of a mesh in the given poses, by its smoothing groups."""
    smoothing = None if mesh.smoothing_groups is None else mesh.smoothing_groups.cpu().numpy()
    return normal_groups(states, mesh.faces.cpu().numpy(), smoothing)


def normal_groups(
    states: Float[np.ndarray, "t v 3"], faces: Int[np.ndarray, "f 3"], smoothing: Int[np.ndarray, " v"] | None
) -> Int[np.ndarray, " v"]:
    """Return groups of vertices that share a normal, numbered from 0 without gaps.

    Its vertices are at one place in the first state, in one connected surface, and in one smoothing group. Copies
    connect surfaces if they coincide in all states.

    Args:
        states: vertices in every pose, any units.
        faces: indices into the vertices.
        smoothing: smoothing groups as in `TexturedMesh`.
    """
    kept, point_of = weld(states)
    welded = point_of[faces]
    surface_of = np.zeros(len(kept), np.int64)
    surface_of[welded] = face_components(len(kept), welded)[:, None]
    labels = [group_vertices(states[0])[1], surface_of[point_of], *([] if smoothing is None else [smoothing])]
    return group_labels(*labels)[1]


def weld(
    states: Float[np.ndarray, "t v 3"], keys: Int[np.ndarray, " v"] | None = None
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " v"]]:
    """Merge vertices that coincide in all states and have equal keys.

    Returns:
        The first vertex of every point, ascending, and the point of every vertex.
    """
    paths = np.ascontiguousarray(states.swapaxes(0, 1)).reshape(states.shape[1], -1) + 0.0  # turns -0 into 0
    rows = paths.view(np.uint8)
    if keys is not None:
        rows = np.concatenate([rows, np.ascontiguousarray(keys[:, None], np.int64).view(np.uint8)], 1)
    _, first, group = np.unique(rows.view(f"V{rows.shape[1]}")[:, 0], return_index=True, return_inverse=True)
    kept, point_of_group = np.unique(first, return_inverse=True)
    return kept, point_of_group[group]
