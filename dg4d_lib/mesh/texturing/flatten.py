"""Flattening of disks: maps of low distortion from parts of a surface to the plane.

Disks are mapped to circles without flips (Tutte 1963) and relaxed by as-rigid-as-possible flattening (Liu et al. 2008),
which has one matrix for all iterations. Where that flips a triangle, the circle is relaxed by scalable locally
injective mappings instead (SLIM, Rabinovich et al. 2017). Many disks are flattened at once, as one block-diagonal
problem.
"""

from typing import Any, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu

from dg4d_lib.kernels.compiling import njit
from dg4d_lib.mesh.neighbors import edge_graph, edge_keys, half_edges

ROTATIONS = 10  # alternations between rotations and vertices; ten more lower the spread of texel density by 1 to 5 %
LEAST_COTANGENT = 0.01  # smaller weights, of obtuse triangles, count as this large
ITERATIONS = 6  # Newton-like steps of SLIM
STEP = 0.8  # share of the largest step without a flipped triangle that is tried first
HALVINGS = 12  # of a step that would increase the energy
LEAST_STRETCH = 1e-4  # singular value of a triangle's map; smaller ones count as this large
PROXIMAL = 1e-4  # weight that keeps vertices near their last position, relative to the mean diagonal of the system
THINNEST = 1e-3  # height of a triangle relative to the mean edge; thinner ones count as this thick
SYMMETRIC: dict[str, Any] = {  # options of SuperLU for positive definite matrices
    "permc_spec": "MMD_AT_PLUS_A",
    "diag_pivot_thresh": 0.0,
    "options": {"SymmetricMode": True},
}

Array = NDArray[np.float64]


def flatten(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], disk: Int[np.ndarray, " f"], count: int
) -> Float[np.ndarray, "v 2"]:
    """Flatten disks; a disk keeps its area. No triangle is flipped, except in degenerate disks.

    Args:
        vertices: any units; every vertex belongs to one disk.
        faces: counter-clockwise seen from outside, and so in the result if v runs up.
        disk: index of the disk of every face.
        count: number of disks, each connected, with one boundary and without handles.
    """
    corners = _local_frames(vertices[faces].astype(np.float64))
    of_vertex = np.zeros(len(vertices), np.int64)
    of_vertex[faces] = disk[:, None]
    sizes = np.bincount(disk, corners[:, 1, 0] * corners[:, 2, 1] / 2, count)
    circles = _to_circles(faces, of_vertex) * np.sqrt(sizes / np.pi)[of_vertex][:, None]
    flat = _as_rigid_as_possible(circles, faces, corners)
    flipped = np.zeros(count, bool)
    flipped[disk[flat_areas(flat, faces) <= 0]] = True
    if flipped.any():
        selected = flipped[disk]
        kept, local = np.unique(faces[selected], return_inverse=True)
        names = np.cumsum(flipped)[disk[selected]] - 1
        flat[kept] = _injective(circles[kept], local.reshape(-1, 3), corners[selected], names, int(flipped.sum()))
    scale = np.sqrt(sizes / np.maximum(np.bincount(disk, flat_areas(flat, faces), count), np.finfo(float).tiny))
    return flat * scale[of_vertex][:, None]


def flat_areas(flat: Float[np.ndarray, "v 2"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, " f"]:
    """Return signed areas of triangles in the plane; counter-clockwise ones are positive."""
    sides = flat[faces[:, 1:]] - flat[faces[:, :1]]
    return np.asarray(_cross(sides[:, 0], sides[:, 1]) / 2)


def overlapping(
    flat: Float[np.ndarray, "v 2"], faces: Int[np.ndarray, "f 3"], disk: Int[np.ndarray, " f"], count: int
) -> Bool[np.ndarray, " d"]:
    """Mark the disks whose boundary crosses itself, so that parts of a map without flips lie over each other."""
    starts, ends = _boundary(faces)
    owner = np.zeros(len(flat), np.int64)
    owner[faces] = disk[:, None]
    order = np.argsort(owner[starts], kind="stable")
    starts, ends = starts[order], ends[order]
    firsts = np.searchsorted(owner[starts], np.arange(count + 1))
    crossed = np.zeros(count, bool)
    _find_crossings(flat, starts, ends, firsts, crossed)
    return crossed


def _local_frames(corners: Float[np.ndarray, "f 3 3"]) -> Float[np.ndarray, "f 3 2"]:
    """Lay every triangle into its plane: the first corner at the origin, the second on the x axis."""
    base, side = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    length = np.linalg.norm(base, axis=1)
    least = max(THINNEST * length.mean(), 1e-12)
    length = np.maximum(length, least)
    along = (base * side).sum(1) / length
    height = np.maximum(np.linalg.norm(np.cross(base, side), axis=1) / length, least)
    laid = np.zeros((len(corners), 3, 2))
    laid[:, 1, 0], laid[:, 2, 0], laid[:, 2, 1] = length, along, height
    return laid


def _boundary(faces: Int[np.ndarray, "f 3"]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return start and end of every edge that one face has."""
    edges = half_edges(faces).astype(np.int64)
    _, first, uses = np.unique(edge_keys(edges), return_index=True, return_counts=True)
    single = edges[first[uses == 1]]
    return single[:, 0], single[:, 1]


def _to_circles(faces: Int[np.ndarray, "f 3"], of_vertex: NDArray[np.int64]) -> Array:
    """Map the boundary of every disk to the unit circle, and every other vertex to the mean of its neighbors."""
    starts, ends = _boundary(faces)
    following = np.full(len(of_vertex), -1)
    following[starts] = ends
    flat = np.zeros((len(of_vertex), 2))
    visited = np.zeros(len(of_vertex), bool)
    for start in starts[np.unique(of_vertex[starts], return_index=True)[1]]:
        loop = [start]
        while following[loop[-1]] != start:
            loop.append(following[loop[-1]])
        angles = 2 * np.pi * np.arange(len(loop)) / len(loop)
        flat[loop] = np.stack([np.cos(angles), np.sin(angles)], 1)
        visited[loop] = True
    inner = np.flatnonzero(~visited & (np.bincount(faces.ravel(), minlength=len(of_vertex)) > 0))
    if len(inner) == 0:
        return flat
    edges = edge_graph(faces, len(of_vertex))
    laplacian = csr_array(diags_array(edges.sum(axis=1)) - edges)[inner]
    flat[inner] = splu(laplacian[:, inner].tocsc(), **SYMMETRIC).solve(-(laplacian @ flat))
    return flat


def _as_rigid_as_possible(flat: Array, faces: Int[np.ndarray, "f 3"], corners: Float[np.ndarray, "f 3 2"]) -> Array:
    """Alternate between the rotation of every triangle and the vertices (Liu et al. 2008, section 4)."""
    count, following = len(flat), np.roll(faces, -1, 1)
    sides = np.roll(corners, -1, 1) - corners  # from every corner to the next
    ahead, behind = np.roll(sides, -1, 1), np.roll(sides, 1, 1)  # they meet at the corner opposite of a side
    weights = np.maximum(-(ahead * behind).sum(-1) / _cross(ahead, behind), LEAST_COTANGENT)
    edge = np.arange(faces.size).repeat(2), np.stack([following, faces], -1).ravel()
    signs = np.tile((1.0, -1.0), faces.size)
    difference = coo_array((signs, edge), shape=(faces.size, count)).tocsr()  # from vertices to sides
    weighted = csr_array(difference.T @ diags_array(weights.ravel()))
    laplacian = (weighted @ difference).tocsc()
    anchor = PROXIMAL * laplacian.diagonal().mean()
    solver = splu((laplacian + anchor * diags_array(np.ones(count))).tocsc(), **SYMMETRIC)
    complex_sides = np.ascontiguousarray(sides).view(np.complex128)[..., 0]  # x + iy
    for _ in range(ROTATIONS):
        now = (difference @ flat).reshape(sides.shape)
        cosine = (weights * (now * sides).sum(-1)).sum(1)
        sine = (weights * _cross(sides, now)).sum(1)
        rotation = cosine + 1j * sine
        turned = complex_sides * _unit(rotation)[:, None]
        flat = solver.solve(weighted @ turned.view(np.float64).reshape(-1, 2) + anchor * flat)
    return flat


def _cross(first: Array, second: Array) -> Array:
    return np.asarray(first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0])


def _injective(
    flat: Array, faces: Int[np.ndarray, "f 3"], corners: Float[np.ndarray, "f 3 2"], disk: NDArray[np.int64], count: int
) -> Array:
    """Relax maps without flipped triangles, without flipping one."""
    areas = corners[:, 1, 0] * corners[:, 2, 1] / 2
    of_vertex = np.zeros(len(flat), np.int64)
    of_vertex[faces] = disk[:, None]
    elements = _Elements(faces, corners, len(flat))
    energy = _energy(elements.jacobians(flat), areas, disk, count)
    for _ in range(ITERATIONS):
        step = _newton_step(elements, flat, areas)
        if step is None:
            break
        length = np.minimum(1.0, STEP * _longest_step(flat, step, faces, disk, count))
        for _ in range(HALVINGS):
            trial = flat + length[of_vertex][:, None] * step
            new = _energy(elements.jacobians(trial), areas, disk, count)
            worse = ~(new <= energy)
            if not worse.any():
                break
            length = np.where(worse, length / 2, length)
        length = np.where(worse, 0.0, length)
        flat = flat + length[of_vertex][:, None] * step
        energy = np.where(worse, energy, new)
    return flat


class _Elements:
    """Linear functions on triangles: their derivatives, and the sparse systems of weighted squares of them.

    The pattern of the systems is that of neighboring vertices, found once. Unknowns are u, v of every vertex in turn.
    """

    def __init__(self, faces: Int[np.ndarray, "f 3"], corners: Float[np.ndarray, "f 3 2"], count: int) -> None:
        base, along, height = corners[:, 1, 0], corners[:, 2, 0], corners[:, 2, 1]
        x = np.stack([-1 / base, 1 / base, np.zeros_like(base)], 1)
        y = np.stack([(along / base - 1) / height, -along / base / height, 1 / height], 1)
        owner, shape = np.repeat(np.arange(len(faces)), 3), (len(faces), count)
        self._x, self._y = (coo_array((part.ravel(), (owner, faces.ravel())), shape=shape).tocsr() for part in (x, y))
        self._products = x[:, None] * x[:, :, None] + y[:, None] * y[:, :, None]
        keys = faces[:, None].astype(np.int64) + count * faces[:, :, None]
        entries, entry = np.unique(keys, return_inverse=True)
        self._entry, self._count = entry.ravel(), count
        columns, rows = np.divmod(entries, count)
        starts = np.searchsorted(columns, np.arange(count + 1))
        lengths = 2 * np.diff(starts)
        self._starts = np.concatenate([[0], np.cumsum(np.repeat(lengths, 2))])
        first = 4 * starts[columns] + 2 * (np.arange(len(entries)) - starts[columns])  # place of u in the column of u
        second = first + lengths[columns]
        self._places = np.stack([first, first + 1, second, second + 1], 1)
        self._rows = np.empty(4 * len(entries), np.int64)
        self._rows[self._places] = np.stack([2 * rows, 2 * rows + 1] * 2, 1)
        self._diagonal = self._places[rows == columns][:, [0, 3]].ravel()

    def jacobians(self, flat: Array) -> Float[np.ndarray, "f 2 2"]:
        """Return the derivatives of a map: rows u and v, columns x and y."""
        return np.stack([self._x @ flat, self._y @ flat], -1)

    def at_vertices(self, stresses: Float[np.ndarray, "f 2 2"]) -> Array:
        """Return the products of stresses with the derivatives, summed at vertices: the transpose of `jacobians`."""
        return np.asarray(self._x.T @ stresses[..., 0] + self._y.T @ stresses[..., 1])

    def system(self, weights: Float[np.ndarray, "f 2 2"]) -> csc_array:
        """Return `at_vertices(weights @ jacobians(...))` as a matrix with a small multiple of the identity added."""
        blocks = (self._products[..., None, None] * weights[:, None, None]).reshape(-1, 4)
        values = np.empty(len(self._rows))
        for part in range(4):
            values[self._places[:, part]] = np.bincount(self._entry, blocks[:, part], len(self._places))
        values[self._diagonal] += PROXIMAL * values[self._diagonal].mean()
        return csc_array((values, self._rows, self._starts), shape=(2 * self._count, 2 * self._count))


def _energy(jacobians: Float[np.ndarray, "f 2 2"], areas: Array, disk: NDArray[np.int64], count: int) -> Array:
    """Return the symmetric Dirichlet energy of every disk; infinite if a triangle is flipped."""
    determinants = np.linalg.det(jacobians)
    squares = np.square(jacobians).sum((1, 2))
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        density = np.where(determinants > 0, squares + squares / np.square(determinants), np.inf)
    return np.bincount(disk, areas * np.nan_to_num(density, nan=np.inf), count).astype(np.float64)


def _newton_step(elements: _Elements, flat: Array, areas: Array) -> Array | None:
    """Return the step to the minimum of the reweighted quadratic energy (Rabinovich et al. 2017, section 3).

    None if a disk is so degenerate that the system has no solution.
    """
    jacobians = elements.jacobians(flat)
    (a, b), (c, d) = jacobians.transpose(1, 2, 0)
    turning, shearing = (a + d + 1j * (c - b)) / 2, (a - d + 1j * (c + b)) / 2  # z -> turning z + shearing conj(z)
    lengths = np.abs(turning), np.abs(shearing)
    stretch = np.maximum(np.stack([lengths[0] + lengths[1], np.abs(lengths[0] - lengths[1])]), LEAST_STRETCH)
    stretch = np.where(np.abs(stretch - 1) < 1e-6, 1 + 1e-6, stretch)  # the limit of the weight at 1 is 2
    larger, smaller = areas * (stretch - stretch**-3) / (stretch - 1)
    weights = _symmetric((larger + smaller) / 2, (larger - smaller) / 2 * _unit(turning * shearing))
    rotation = _unit(turning)
    rotations = np.stack([rotation.real, -rotation.imag, rotation.imag, rotation.real], -1).reshape(-1, 2, 2)
    target = elements.at_vertices(weights @ (rotations - jacobians))
    try:
        step = splu(elements.system(weights), **SYMMETRIC).solve(target.ravel())
    except RuntimeError:  # singular
        return None
    return np.asarray(step.reshape(-1, 2)) if np.isfinite(step).all() else None


def _unit(values: NDArray[np.complex128]) -> NDArray[np.complex128]:
    return np.asarray(values / np.maximum(np.abs(values), np.finfo(float).tiny))


def _symmetric(mean: Array, deviation: NDArray[np.complex128]) -> Float[np.ndarray, "f 2 2"]:
    """Return the symmetric matrices with two eigenvalues `mean +- abs(deviation)`, the axes at half its angle."""
    x, y = deviation.real, deviation.imag
    return np.stack([mean + x, y, y, mean - x], -1).reshape(-1, 2, 2)


def _longest_step(
    flat: Array, step: Array, faces: Int[np.ndarray, "f 3"], disk: NDArray[np.int64], count: int
) -> Array:
    """Return for every disk the factor of the step at which its first triangle loses its area."""
    sides, moves = (values[faces[:, 1:]] - values[faces[:, :1]] for values in (flat, step))
    square = _cross(moves[:, 0], moves[:, 1])
    linear = _cross(sides[:, 0], moves[:, 1]) + _cross(moves[:, 0], sides[:, 1])
    constant = _cross(sides[:, 0], sides[:, 1])
    # the smallest positive root of square t^2 + linear t + constant, in a form without cancellation
    discriminant = np.square(linear) - 4 * square * constant
    root = np.sqrt(np.maximum(discriminant, 0))
    half = -(linear + np.where(linear >= 0, root, -root)) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        roots = np.stack([half / square, constant / half], 1)
    roots = np.where((roots > 0) & (discriminant >= 0)[:, None], roots, np.inf).min(1)
    longest = np.full(count, np.inf)
    np.minimum.at(longest, disk, roots)
    return longest


@njit(cache=True, nogil=True)
@no_type_check
def _find_crossings(flat, starts, ends, firsts, crossed):
    """Test all pairs of boundary edges of every disk that share no vertex."""
    for d in range(len(crossed)):
        for i in range(firsts[d], firsts[d + 1]):
            a, b = starts[i], ends[i]
            low_x, high_x = min(flat[a, 0], flat[b, 0]), max(flat[a, 0], flat[b, 0])
            low_y, high_y = min(flat[a, 1], flat[b, 1]), max(flat[a, 1], flat[b, 1])
            for j in range(i + 1, firsts[d + 1]):
                c, e = starts[j], ends[j]
                if a in (c, e) or b in (c, e):
                    continue
                if max(flat[c, 0], flat[e, 0]) < low_x or min(flat[c, 0], flat[e, 0]) > high_x:
                    continue
                if max(flat[c, 1], flat[e, 1]) < low_y or min(flat[c, 1], flat[e, 1]) > high_y:
                    continue
                ux, uy = flat[b, 0] - flat[a, 0], flat[b, 1] - flat[a, 1]
                wx, wy = flat[e, 0] - flat[c, 0], flat[e, 1] - flat[c, 1]
                first = ux * (flat[c, 1] - flat[a, 1]) - uy * (flat[c, 0] - flat[a, 0])
                second = ux * (flat[e, 1] - flat[a, 1]) - uy * (flat[e, 0] - flat[a, 0])
                third = wx * (flat[a, 1] - flat[c, 1]) - wy * (flat[a, 0] - flat[c, 0])
                fourth = wx * (flat[b, 1] - flat[c, 1]) - wy * (flat[b, 0] - flat[c, 0])
                if first * second <= 0 and third * fourth <= 0:
                    crossed[d] = True
                    break
            if crossed[d]:
                break
