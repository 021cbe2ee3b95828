"""Subdivision of coarse triangle meshes to a largest edge length, without cracks."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

MAX_ROUNDS = 12  # each halves the long edges
_CORNERS = np.eye(3)


@dataclass(frozen=True)
class FineMesh:
    """Subdivided mesh, with the original face and barycentrics of every face.

    Attributes:
        vertices: the original vertices first, then edge midpoints.
        faces: indices into `vertices`.
        sources: original face of every face.
        barycentrics: of the corners in the original face.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    sources: Int[np.ndarray, " f"]
    barycentrics: Float[np.ndarray, "f 3 3"]


def subdivide(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], longest: float, max_vertices: int
) -> FineMesh:
    """Split edges at their midpoints until none is longer than `longest`, or the next round would exceed the limit.

    Faces that share an edge share its midpoint, so that the mesh stays connected.

    Args:
        vertices: any units.
        faces: indices into the vertices.
        longest: edge length, same units.
        max_vertices: bound on the number of vertices.
    """
    sources = np.arange(len(faces))
    barycentrics = np.broadcast_to(_CORNERS, (len(faces), 3, 3)).copy()
    for _ in range(MAX_ROUNDS):
        ends = np.sort(np.stack([faces, np.roll(faces, -1, 1)], -1), -1)  # edge k joins the corners k and k + 1
        edges, index = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
        index = index.reshape(-1, 3)
        long = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1) > longest
        if not long.any() or len(vertices) + int(long.sum()) > max_vertices:
            break
        middle = np.full(len(edges), -1)
        middle[long] = len(vertices) + np.arange(int(long.sum()))
        vertices = np.concatenate([vertices, vertices[edges[long]].mean(1)])
        faces, sources, barycentrics = _split(faces, middle[index], sources, barycentrics)
    return FineMesh(vertices, faces, sources, barycentrics)


def _split(
    faces: Int[np.ndarray, "f 3"],
    middles: Int[np.ndarray, "f 3"],
    sources: Int[np.ndarray, " f"],
    barycentrics: Float[np.ndarray, "f 3 3"],
) -> tuple[Int[np.ndarray, "g 3"], Int[np.ndarray, " g"], Float[np.ndarray, "g 3 3"]]:
    """Divide faces at the given midpoints of their edges (-1: none) into one to four."""
    count = (middles >= 0).sum(1)
    turn = np.where(count == 1, (middles >= 0).argmax(1), (middles < 0).argmax(1))  # brings them into one of four forms
    order = (np.arange(3) + turn[:, None]) % 3
    rows = np.arange(len(faces))[:, None]
    points = np.concatenate([faces[rows, order], middles[rows, order]], 1)  # three corners, three midpoints
    corners = barycentrics[rows, order]
    places = np.concatenate([corners, 0.5 * (corners + np.roll(corners, -1, 1))], 1)
    forms = {
        0: ((0, 1, 2),),
        1: ((0, 3, 2), (3, 1, 2)),  # the first edge is split
        2: ((0, 1, 4), (0, 4, 5), (5, 4, 2)),  # all but the first
        3: ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)),
    }
    parts = []
    for number, triangles in forms.items():
        selected = count == number
        for triangle in triangles:
            parts.append((points[selected][:, triangle], sources[selected], places[selected][:, triangle]))
    new_faces, new_sources, new_places = (np.concatenate(values) for values in zip(*parts, strict=True))
    return new_faces, new_sources, new_places
