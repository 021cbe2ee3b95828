"""Defects of a surface that light shows: self-intersections, folds, flipped faces and handles.

Silhouettes and unlit comparisons are blind to them. All measures expect vertices that are welded along texture seams.
"""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Float64, Int

from dg4d_lib.geometry.rotation import nearest_rotation
from dg4d_lib.kernels.compiling import njit
from dg4d_lib.mesh.extraction.topology import face_components
from dg4d_lib.mesh.neighbors import faces_to_vertices, half_edges, mesh_edges

FOLD_DEG = 120.0  # between the normals of neighboring faces: the surface turns back on itself
CREASE_DEG = 60.0  # between the normals of neighboring faces: a hard edge, seldom meant on creatures
LONGEST_CELLS = 256  # cells of the search grid along the longest side of the mesh
LARGE = 64  # mean sizes of a face: larger ones, such as a ground plane, are compared with all and not put into the grid


@dataclass(frozen=True)
class SurfaceDefects:
    """Counts of the defects of a surface in one frame.

    Attributes:
        faces: number of faces.
        self_intersecting: faces that another face crosses.
        flipped: faces that point against the local rotation of the surface; 0 at rest.
        folds: edges whose faces differ by more than 120 degrees.
        creases: edges whose faces differ by more than 60 degrees.
        normal_deviation_deg: root mean square angle between neighboring faces.
    """

    faces: int
    self_intersecting: int
    flipped: int
    folds: int
    creases: int
    normal_deviation_deg: float


class DefectFinder:
    """Defects of one triangulation in many poses; neighbors and the rest shape are prepared once."""

    def __init__(self, faces: Int[np.ndarray, "f 3"], rest: Float[np.ndarray, "v 3"] | None = None) -> None:
        """Prepare the search.

        Args:
            faces: counter-clockwise seen from outside, welded.
            rest: vertices of the rest shape, against which faces count as flipped; None: none do.
        """
        self._faces, self._rest = faces, rest
        self._first, self._second, _ = neighboring_faces(faces)
        if rest is not None:
            self._normals_at_rest = unit_normals(rest, faces)

    def defective(
        self, vertices: Float[np.ndarray, "v 3"], near: Bool[np.ndarray, " f"] | None = None
    ) -> Bool[np.ndarray, " f"]:
        """Mark faces that intersect others, are flipped or lie at a fold.

        Args:
            vertices: of the pose.
            near: faces that are searched; of the others, only some that share a defect with one of them are marked.
                None: all.
        """
        searched = np.ones(len(self._faces), np.bool_) if near is None else near
        at_edges = searched[self._first] | searched[self._second]
        first, second = self._first[at_edges], self._second[at_edges]
        around, normals = searched.copy(), np.zeros((len(self._faces), 3))
        around[first] = around[second] = True
        normals[around] = unit_normals(vertices, self._faces[around])
        marked = self_intersecting(vertices, self._faces, near) | self._flipped(vertices, normals, searched)
        folded = np.einsum("ei,ei->e", normals[first], normals[second]) < np.cos(np.radians(FOLD_DEG))
        marked[first[folded]] = marked[second[folded]] = True
        return marked

    def updated(
        self, marked: Bool[np.ndarray, " f"], before: Float[np.ndarray, "v 3"], vertices: Float[np.ndarray, "v 3"]
    ) -> Bool[np.ndarray, " f"]:
        """Mark the same as `defective` in less time, where the pose differs from another one in some places.

        Args:
            marked: defective faces of the other pose.
            before: vertices of the other pose.
            vertices: of the pose.
        """
        touched = (before != vertices).any(1)[self._faces].any(1)
        if not touched.any():
            return marked
        low, high = _boxes(vertices, self._faces)
        places = np.concatenate([before[self._faces[touched]], vertices[self._faces[touched]]]).reshape(-1, 3)
        here = ((low <= places.max(0)) & (high >= places.min(0))).all(1)
        # other faces that crossed one that moved may cross a third one, too
        near = faces_to_vertices(touched, self._faces, len(vertices))[self._faces].any(1) | (marked & here)
        return self.defective(vertices, near) | (marked & ~near)

    def flipped(self, vertices: Float[np.ndarray, "v 3"]) -> Bool[np.ndarray, " f"]:
        """Mark faces that point against the local rotation of the surface; none without a rest shape."""
        searched = np.ones(len(self._faces), np.bool_)
        return self._flipped(vertices, unit_normals(vertices, self._faces), searched)

    def count(self, vertices: Float[np.ndarray, "v 3"]) -> SurfaceDefects:
        """Count the defects of a pose."""
        normals = unit_normals(vertices, self._faces)
        cosines = np.einsum("ei,ei->e", normals[self._first], normals[self._second])
        angles = np.degrees(np.arccos(cosines.clip(-1, 1)))
        return SurfaceDefects(
            faces=len(self._faces),
            self_intersecting=int(self_intersecting(vertices, self._faces).sum()),
            flipped=int(self._flipped(vertices, normals, np.ones(len(self._faces), np.bool_)).sum()),
            folds=int((angles > FOLD_DEG).sum()),
            creases=int((angles > CREASE_DEG).sum()),
            normal_deviation_deg=float(np.sqrt(np.mean(np.square(angles)))) if len(angles) else 0.0,
        )

    def _flipped(
        self,
        vertices: Float[np.ndarray, "v 3"],
        normals: Float[np.ndarray, "f 3"],
        searched: Bool[np.ndarray, " f"],
    ) -> Bool[np.ndarray, " f"]:
        """Mark searched faces whose normal points against the rotation that fits the neighborhood best.

        The neighborhood of a face are the edges at its three corners; the rotation is that of Kabsch.
        """
        marked = np.zeros(len(self._faces), np.bool_)
        if self._rest is None:
            return marked
        corners = faces_to_vertices(searched, self._faces, len(vertices))
        poses = (np.asarray(pose, np.float64) for pose in (vertices, self._rest))
        _mark_flipped(*poses, self._faces, normals, self._normals_at_rest, searched, corners, marked)
        return marked


def surface_defects(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], rest: Float[np.ndarray, "v 3"] | None = None
) -> SurfaceDefects:
    """Count the defects of one pose; for many poses of a mesh, use `DefectFinder`.

    Args:
        vertices: of the surface, any units.
        faces: counter-clockwise seen from outside.
        rest: vertices of the rest shape, against which faces count as flipped; None: these are the rest shape.
    """
    return DefectFinder(faces, rest).count(vertices)


def genus(faces: Int[np.ndarray, "f 3"]) -> int:
    """Return the number of handles of a closed surface, summed over its components (Euler characteristic)."""
    used = np.unique(faces)
    edges = mesh_edges(faces)
    components = int(face_components(int(faces.max()) + 1, faces).max()) + 1
    return (2 * components - (len(used) - len(edges) + len(faces))) // 2


def neighboring_faces(
    faces: Int[np.ndarray, "f 3"],
) -> tuple[Int[np.ndarray, " e"], Int[np.ndarray, " e"], Int[np.ndarray, "e 2"]]:
    """Return the two faces of every edge that has two, and its ends."""
    sides = np.sort(half_edges(faces), 1)
    order = np.lexsort(sides.T)
    edges, owners = sides[order], np.repeat(np.arange(len(faces)), 3)[order]
    twin = np.flatnonzero((edges[1:] == edges[:-1]).all(1))
    return owners[twin], owners[twin + 1], edges[twin]


def unit_normals(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 3"]:
    """Return the normals of the faces; 0 for faces without area."""
    normals = area_normals(vertices, faces)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-300)


def area_normals(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 3"]:
    """Return the normals of the faces, of twice their area as length."""
    a, b, c = (vertices[corner].astype(np.float64) for corner in faces.T)
    return np.cross(b - a, c - a)


def self_intersecting(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], near: Bool[np.ndarray, " f"] | None = None
) -> Bool[np.ndarray, " f"]:
    """Mark faces that an edge of another face crosses, or that cross another face with an edge of their own.

    Faces that only touch, at a corner or along an edge, do not count.

    Args:
        vertices: positions.
        faces: indices into the vertices.
        near: faces that are searched; of the others, those that cross one of them are marked. None: all.
    """
    marked = np.zeros(len(faces), np.bool_)
    searched = np.ones_like(marked) if near is None else near
    if not searched.any():
        return marked
    low, high = _boxes(vertices, faces)
    if near is not None:
        some = np.flatnonzero(((low <= high[near].max(0)) & (high >= low[near].min(0))).all(1))
        marked[some] = _crossing(vertices, faces[some], low[some], high[some], searched[some])
        return marked
    return _crossing(vertices, faces, low, high, searched)


def _boxes(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float64[np.ndarray, "f 3"], Float64[np.ndarray, "f 3"]]:
    """Return the lowest and highest coordinates of every face."""
    a, b, c = (vertices[corner].astype(np.float64) for corner in faces.T)
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)  # four times as fast as along an axis


def _crossing(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    low: Float64[np.ndarray, "f 3"],
    high: Float64[np.ndarray, "f 3"],
    searched: Bool[np.ndarray, " f"],
) -> Bool[np.ndarray, " f"]:
    """Mark faces that cross a searched one, or are searched and cross any, by a grid of cells."""
    marked = np.zeros(len(faces), np.bool_)
    points, corners = np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64)
    sizes = (high - low).max(1)
    large = sizes > LARGE * sizes.mean()
    if large.any():
        rest = ~large
        marked[rest] = _crossing(vertices, faces[rest], low[rest], high[rest], searched[rest])
        _cross_large(points, corners, low, high, np.flatnonzero(large), searched, marked)
        return marked
    extent = float((high.max(0) - low.min(0)).max())
    cell = max(2 * float((high - low).mean()), extent / LONGEST_CELLS, 1e-300)
    first = ((low - low.min(0)) / cell).astype(np.int64)
    last = ((high - low.min(0)) / cell).astype(np.int64)
    shape = last.max(0) + 1
    starts, members = _fill_grid(first, last, shape, searched)
    _cross_faces(points, corners, low, high, low.min(0), cell, shape, starts, members, searched, marked)
    return marked


@njit(cache=True, nogil=True)
@no_type_check
def _mark_flipped(vertices, rest, faces, normals, normals_at_rest, searched, corners, marked):
    """Mark the searched faces, with their corners, whose normals point against those at rest, turned as around them."""
    at_vertex = np.zeros((len(vertices), 3, 3))
    for face in faces:
        if not (corners[face[0]] or corners[face[1]] or corners[face[2]]):
            continue
        for k in range(3):
            i, j = face[k], face[(k + 1) % 3]
            for a in range(3):
                for b in range(3):
                    product = (vertices[j, a] - vertices[i, a]) * (rest[j, b] - rest[i, b])
                    at_vertex[i, a, b] += product
                    at_vertex[j, a, b] += product
    rotation = np.empty((3, 3))
    for f in np.flatnonzero(searched):
        nearest_rotation(at_vertex[faces[f, 0]] + at_vertex[faces[f, 1]] + at_vertex[faces[f, 2]], rotation)
        cosine = 0.0
        for a in range(3):
            for b in range(3):
                cosine += normals[f, a] * rotation[a, b] * normals_at_rest[f, b]
        marked[f] = cosine < 0


@njit(cache=True, nogil=True)
@no_type_check
def _searched_cells(first, last, shape, searched):
    """Mark the cells that the bounding boxes of searched faces touch."""
    wanted = np.zeros(shape[0] * shape[1] * shape[2], np.bool_)
    for face in np.flatnonzero(searched):
        for x in range(first[face, 0], last[face, 0] + 1):
            for y in range(first[face, 1], last[face, 1] + 1):
                start = (x * shape[1] + y) * shape[2]
                wanted[start + first[face, 2] : start + last[face, 2] + 1] = True
    return wanted


@njit(cache=True, nogil=True)
@no_type_check
def _fill_grid(first, last, shape, searched):
    """List the faces of every cell that the bounding box of a searched face touches, as offsets and members."""
    wanted = _searched_cells(first, last, shape, searched)
    counts = np.zeros(len(wanted) + 1, np.int64)
    for fill in range(2):
        if fill:
            starts = np.cumsum(counts)
            starts[1:] = starts[:-1].copy()
            starts[0] = 0
            members = np.empty(counts.sum(), np.int64)
            places = starts.copy()
        for face in range(len(first)):
            for x in range(first[face, 0], last[face, 0] + 1):
                for y in range(first[face, 1], last[face, 1] + 1):
                    for z in range(first[face, 2], last[face, 2] + 1):
                        cell = (x * shape[1] + y) * shape[2] + z
                        if not wanted[cell]:
                            continue
                        if fill:
                            members[places[cell]] = face
                            places[cell] += 1
                        else:
                            counts[cell] += 1
    return starts, members


@njit(cache=True, nogil=True)
@no_type_check
def _cross_faces(points, faces, low, high, origin, size, shape, starts, members, searched, marked):
    """Mark the faces that cross another one, pairs with a searched face, in the first cell that both boxes share."""
    for cell in range(len(starts) - 1):
        z, y, x = cell % shape[2], cell // shape[2] % shape[1], cell // (shape[1] * shape[2])
        for m in range(starts[cell], starts[cell + 1]):
            for n in range(starts[cell], m):
                i, j = members[m], members[n]
                if (marked[i] and marked[j]) or not (searched[i] or searched[j]) or _apart(low, high, i, j):
                    continue
                here = (
                    int((max(low[i, 0], low[j, 0]) - origin[0]) / size) == x
                    and int((max(low[i, 1], low[j, 1]) - origin[1]) / size) == y
                    and int((max(low[i, 2], low[j, 2]) - origin[2]) / size) == z
                )
                if here and _faces_cross(points, faces[i], faces[j]):
                    marked[i] = marked[j] = True


@njit(cache=True, nogil=True)
@no_type_check
def _cross_large(points, faces, low, high, large, searched, marked):
    """Mark the large faces that cross another one, and those that they cross, pairs with a searched face."""
    for i in large:
        for j in range(len(faces)):
            if i == j or (marked[i] and marked[j]) or not (searched[i] or searched[j]) or _apart(low, high, i, j):
                continue
            if _faces_cross(points, faces[i], faces[j]):
                marked[i] = marked[j] = True


@njit(cache=True, nogil=True)
@no_type_check
def _apart(low, high, i, j):
    """Return whether the bounding boxes of two faces have no place in common."""
    apart = False
    for axis in range(3):
        apart |= low[i, axis] > high[j, axis] or low[j, axis] > high[i, axis]
    return apart


@njit(cache=True, nogil=True)
@no_type_check
def _faces_cross(points, a, b):
    """Return whether an edge of one face passes through the other; edges that end on it at a shared corner do not."""
    if _on_one_side(points, a, b) or _on_one_side(points, b, a):  # most pairs
        return False
    return _edges_cross(points, a, b) or _edges_cross(points, b, a)


@njit(cache=True, nogil=True)
@no_type_check
def _on_one_side(points, a, b):
    """Return whether the plane of the first face leaves the second one on one side, shared corners aside."""
    below, above = False, False
    for corner in b:
        if corner not in (a[0], a[1], a[2]):
            volume = _volume(points[a[0]], points[a[1]], points[a[2]], points[corner])
            below |= volume < 0
            above |= volume > 0
    return not (below and above)


@njit(cache=True, nogil=True)
@no_type_check
def _edges_cross(points, a, b):
    for k in range(3):
        p, q = a[k], a[(k + 1) % 3]
        shared = False
        for corner in b:
            shared |= corner in (p, q)
        if not shared and _segment_crosses(points[p], points[q], points[b[0]], points[b[1]], points[b[2]]):
            return True
    return False


@njit(cache=True, nogil=True)
@no_type_check
def _segment_crosses(p, q, a, b, c):
    """Return whether the open segment pq passes through the inside of the triangle, by signs of volumes."""
    if _volume(a, b, c, p) * _volume(a, b, c, q) >= 0:
        return False
    u, v, w = _volume(p, q, a, b), _volume(p, q, b, c), _volume(p, q, c, a)
    return (u > 0 and v > 0 and w > 0) or (u < 0 and v < 0 and w < 0)


@njit(cache=True, nogil=True)
@no_type_check
def _volume(a, b, c, d):
    """Return six times the signed volume of a tetrahedron."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    wx, wy, wz = d[0] - a[0], d[1] - a[1], d[2] - a[2]
    return ux * (vy * wz - vz * wy) + uy * (vz * wx - vx * wz) + uz * (vx * wy - vy * wx)
