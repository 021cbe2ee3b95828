"""Topology checks of triangle meshes: holes, non-manifold edges, orientation and degenerate faces."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

FLATTEST = 1e-6  # height over longest side below which a triangle is degenerate; rounding moves corners by as much


@dataclass(frozen=True)
class MeshTopology:
    """Counts of a mesh's parts and defects.

    Attributes:
        triangles: number of triangles.
        components: connected components by shared vertices.
        boundary_edges: edges of one triangle, along holes.
        nonmanifold_edges: edges of more than two triangles.
        inconsistent_edges: edges whose two triangles have opposite orientations.
        degenerate_faces: triangles without area.
        inverted_components: components whose faces point inwards.
    """

    triangles: int
    components: int
    boundary_edges: int
    nonmanifold_edges: int
    inconsistent_edges: int
    degenerate_faces: int
    inverted_components: int

    @property
    def watertight(self) -> bool:
        """True if every edge belongs to two triangles of the same orientation, so that the mesh bounds a solid."""
        return not self.boundary_edges and not self.nonmanifold_edges and not self.inconsistent_edges

    @property
    def valid(self) -> bool:
        """True if the mesh is watertight, oriented outwards and free of degenerate faces."""
        return self.watertight and not self.inverted_components and not self.degenerate_faces

    def __str__(self) -> str:
        """Summary in one line, for reports."""
        if self.watertight:
            kind = "watertight"
        elif self.boundary_edges:
            kind = f"open, {_count(self.boundary_edges, 'boundary edge')}"
        else:
            kind = "closed, but bounds no solid"
        defects = (
            _count(self.nonmanifold_edges, "non-manifold edge") if self.nonmanifold_edges else "",
            _count(self.inconsistent_edges, "inconsistently oriented edge") if self.inconsistent_edges else "",
            _count(self.degenerate_faces, "degenerate triangle") if self.degenerate_faces else "",
        )
        components = (_count(self.components, "component"), f"{self.inverted_components} inverted")
        return ", ".join((kind, *components, *filter(None, defects)))


def check_topology(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> MeshTopology:
    """Count components, holes and defects of a mesh.

    Args:
        vertices: any units; vertices at the same position count as different, so weld a mesh that is split at seams.
        faces: counter-clockwise seen from outside.
    """
    starts, ends = faces.ravel(), np.roll(faces, -1, 1).ravel()
    forward = starts < ends
    pairs = np.stack([np.where(forward, starts, ends), np.where(forward, ends, starts)], 1)
    _, edge, uses = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    directions = np.bincount(edge.ravel(), np.where(forward, 1, -1), minlength=len(uses))  # 0 if two triangles agree
    volumes = _volumes(vertices, faces, face_components(len(vertices), faces))
    return MeshTopology(
        triangles=len(faces),
        components=len(volumes),
        boundary_edges=int((uses == 1).sum()),
        nonmanifold_edges=int((uses > 2).sum()),
        inconsistent_edges=int(((uses == 2) & (directions != 0)).sum()),
        degenerate_faces=int(_degenerate(vertices, faces).sum()),
        inverted_components=int((volumes < 0).sum()),
    )


def weld_vertices(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "f 3"]]:
    """Merge vertices at equal positions, which undoes the split along texture seams."""
    first, joined = join_seams(vertices, faces)
    return vertices[first], joined


def join_seams(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Int[np.ndarray, " w"], Int[np.ndarray, "f 3"]]:
    """Return one vertex of every position, and the faces between these; so a moved mesh is welded as at rest."""
    first, index = group_vertices(vertices)
    return first, index[faces]


def group_vertices(
    vertices: Float[np.ndarray, "v 3"], tolerance: float = 0.0
) -> tuple[Int[np.ndarray, " w"], Int[np.ndarray, " v"]]:
    """Return the first vertex of every position, positions in ascending order, and the position of every vertex.

    Args:
        vertices: any units.
        tolerance: side of the cells that count as one position, same units; 0: equal positions.
    """
    keys = np.round(vertices / tolerance).astype(np.int64) if tolerance > 0 else vertices
    _, first, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return first, index.ravel()


def group_labels(*labels: Int[np.ndarray, " v"]) -> tuple[Int[np.ndarray, " w"], Int[np.ndarray, " v"]]:
    """Return the first vertex of every combination of labels, and the combination of every vertex, from 0."""
    _, first, group = np.unique(np.stack(labels, 1), axis=0, return_index=True, return_inverse=True)
    return first, group.ravel()


def orient_outward(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "f 3"]:
    """Flip the faces of inverted components; the triangles of a component must be consistently oriented."""
    components = face_components(len(vertices), faces)
    inverted = (_volumes(vertices, faces, components) < 0)[components]
    return np.where(inverted[:, None], faces[:, ::-1], faces)


def face_components(vertex_count: int, faces: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, " f"]:
    """Return the index of the connected component of every triangle, numbered from 0."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]]).T
    graph = coo_array((np.ones(ends.shape[1], bool), tuple(ends)), shape=(vertex_count, vertex_count))
    labels = connected_components(graph, directed=False)[1][faces[:, 0]]
    return np.unique(labels, return_inverse=True)[1]


def _volumes(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], components: Int[np.ndarray, " f"]
) -> Float[np.ndarray, " c"]:
    """Return the signed volume of every component; an open one is closed by a cone to its own center."""
    corners = vertices[faces].astype(np.float64)
    sums = np.stack([np.bincount(components, corners[..., axis].mean(1)) for axis in range(3)], 1)
    centers = sums / np.bincount(components)[:, None]
    a, b, c = np.moveaxis(corners - centers[components][:, None], 1, 0)
    return np.bincount(components, np.einsum("fi,fi->f", a, np.cross(b, c)) / 6).astype(np.float64)


def _degenerate(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> np.ndarray:
    corners = vertices[faces].astype(np.float64)
    sides = np.roll(corners, -1, 1) - corners
    doubled_area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    longest2 = np.square(sides).sum(-1).max(1)
    return doubled_area <= FLATTEST * longest2


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
