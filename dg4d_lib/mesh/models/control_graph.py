"""Control nodes on a surface, with skinning weights by distance along it (embedded deformation, Sumner et al. 2007).

Distances follow the surface, so that a leg does not move with the other one that it touches. Separate components, such
as eyes, are joined by bridges to their nearest neighbors and move with them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn import functional

from dg4d_lib.mesh.neighbors import mesh_edges

NEIGHBORS = 4  # nodes that move a point
POINT_NEIGHBORS = 8  # nearest points to which a point without edges is joined
BRIDGES = 6  # edges from a component to each component that it touches
TOUCHING = 1.5  # factor on the smallest gap of a component: others within it are joined to it, too
LINKS = 6  # nearest nodes of a node in the graph
BRACES = 4  # edges of a node through the inside
BRACE_REACH = 0.35  # largest length of braces, share of the bounding box diagonal
PLACES = 7  # evenly spaced points of a brace that must be inside the surface
INWARD = 0.5  # least cosine between a brace and the inward normals at its ends
SHORTEST = 1e-6  # world units: length of an edge between points at one place
REACH = 6.0  # node spacings: limit of the graph distances


@dataclass(frozen=True)
class ControlGraph:
    """Nodes, the points that they move, and the edges between them.

    Attributes:
        nodes: positions at rest, world units.
        indices: nodes that move every point.
        weights: of these nodes, sum 1.
        edges: pairs of neighboring nodes.
        lengths: of the edges at rest, along the straight line; never 0.
    """

    nodes: Float[Tensor, "m 3"]
    indices: Int[Tensor, "v k"]
    weights: Float[Tensor, "v k"]
    edges: Int[Tensor, "e 2"]
    lengths: Float[Tensor, " e"]

    @cached_property
    def spans(self) -> Float[Tensor, "e 3"]:
        """Vectors along the edges at rest, from the first node to the second one."""
        ends = self.nodes[self.edges]
        return ends[:, 1] - ends[:, 0]

    def of(self, rows: Int[Tensor, " n"]) -> "ControlGraph":
        """Return the same nodes with the weights of some of the points."""
        return replace(self, indices=self.indices[rows], weights=self.weights[rows])

    def blend(self, values: Float[Tensor, "t m c"]) -> Float[Tensor, "t v c"]:
        """Return the weighted mean of the nodes' values at every point; its gradient is the same in every run."""
        return self._blending @ values

    def blend_rotations(self, quats: Float[Tensor, "t m 4"]) -> Float[Tensor, "t v 4"]:
        """Return the weighted mean of the nodes' rotations at every point, unit quaternions.

        A quaternion and its negative are one rotation: each is taken with the sign that is nearer to the quaternion of
        the point's strongest node.

        Args:
            quats: of the nodes, wxyz, unit.
        """
        turns = quats[:, self.indices]  # t v k 4
        strongest = self.indices.gather(1, self.weights.argmax(1, keepdim=True))
        weights = torch.where((turns * quats[:, strongest]).sum(-1) < 0, -self.weights, self.weights)
        return functional.normalize((turns * weights[..., None]).sum(2), dim=-1)

    def at_ends(self, values: Float[Tensor, "t m c"]) -> tuple[Float[Tensor, "t e c"], Float[Tensor, "t e c"]]:
        """Return the nodes' values at both ends of the edges; their gradient is the same in every run."""
        first, second = self._ends
        return first @ values, second @ values

    @cached_property
    def _blending(self) -> Float[Tensor, "v m"]:
        return self.weights.new_zeros(len(self.indices), len(self.nodes)).scatter_(1, self.indices, self.weights)

    @cached_property
    def _ends(self) -> tuple[Float[Tensor, "e m"], Float[Tensor, "e m"]]:
        """Matrices that choose the rows of either end: the gradient of indexing adds in any order on a GPU."""
        first, second = functional.one_hot(self.edges.T, len(self.nodes)).to(self.lengths)
        return first, second


def build_control_graph(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], count: int, braced: bool = True
) -> ControlGraph:
    """Distribute nodes evenly over a surface and compute the weights of its vertices.

    Args:
        vertices: of a mesh with short edges, welded.
        faces: indices into the vertices.
        count: number of nodes; at most one per vertex.
        braced: edges run through the inside, too.
    """
    control = graph_of_points(vertices, surface_graph(vertices, faces), count)
    return _braced(control, vertices, _outward(vertices, faces)) if braced else control


def graph_of_points(points: Float[np.ndarray, "v 3"], graph: csr_array, count: int) -> ControlGraph:
    """Return the control graph of connected points; see `build_control_graph`.

    Args:
        points: world units.
        graph: symmetric matrix of the distances between neighboring points, connected.
        count: number of nodes; at most one per point.
    """
    selected, spacing = spread_nodes(graph, points, min(count, len(points)))
    nearest = min(max(NEIGHBORS + 1, LINKS + 1), len(selected))
    distances = graph_distances(graph, selected, REACH * spacing).astype(np.float32)  # m v
    distances = np.minimum(distances, REACH * spacing)
    order = np.argpartition(distances, nearest - 1, axis=0)[:nearest].T
    near = np.take_along_axis(distances.T, order, 1)
    rank = near.argsort(1, kind="stable")
    order, near = np.take_along_axis(order, rank, 1), np.take_along_axis(near, rank, 1)
    used = min(NEIGHBORS, len(selected))
    reach = near[:, min(used, nearest - 1), None] if nearest > used else near[:, -1:] * 1.001 + 1e-9
    weights = np.square(1 - near[:, :used] / np.maximum(reach, 1e-9)).clip(1e-8)
    weights /= weights.sum(1, keepdims=True)
    links = order[selected, 1 : LINKS + 1]
    pairs = np.stack([np.repeat(np.arange(len(selected)), links.shape[1]), links.ravel()], 1)
    pairs = np.unique(np.sort(pairs, 1), axis=0)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    nodes = points[selected]
    lengths = np.linalg.norm(nodes[pairs[:, 0]] - nodes[pairs[:, 1]], axis=1).clip(SHORTEST)
    return ControlGraph(
        torch.from_numpy(nodes.astype(np.float32)),
        torch.from_numpy(order[:, :used].astype(np.int64)),
        torch.from_numpy(weights.astype(np.float32)),
        torch.from_numpy(pairs.astype(np.int64)),
        torch.from_numpy(lengths.astype(np.float32)),
    )


def _outward(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "v 3"]:
    """Return unit normals of the vertices; of pieces that are inside out, turned."""
    a, b, c = vertices[faces].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    volumes = (a * np.cross(b, c)).sum(1)
    edges = mesh_edges(faces)
    piece = connected_components(_lengths(vertices, edges), directed=False)[1][faces[:, 0]]
    normals[np.bincount(piece, volumes)[piece] < 0] *= -1
    smooth = np.stack([np.bincount(faces.ravel(), np.repeat(normals[:, k], 3), len(vertices)) for k in range(3)], 1)
    unit: Float[np.ndarray, "v 3"] = smooth / np.linalg.norm(smooth, axis=1, keepdims=True).clip(1e-12)
    return unit


def _braced(
    control: ControlGraph, vertices: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"]
) -> ControlGraph:
    """Add edges through the inside, so that the surface is as stiff as a solid.

    A straight line between two nodes runs inside if it leaves both against their normals, and if places on it lie
    behind the vertices next to them; through two legs it does not.
    """
    nodes = control.nodes.double().numpy()
    surface = cKDTree(vertices)
    own = normals[np.asarray(surface.query(nodes)[1], np.int64)]
    near = cKDTree(nodes).query_pairs(BRACE_REACH * float(np.linalg.norm(np.ptp(nodes, axis=0))), output_type="ndarray")
    spans = nodes[near[:, 1]] - nodes[near[:, 0]]
    lengths = np.linalg.norm(spans, axis=1)
    leaves = -(spans * own[near[:, 0]]).sum(1), (spans * own[near[:, 1]]).sum(1)
    inside = np.minimum(*leaves) > INWARD * lengths
    near, lengths, spans = near[inside], lengths[inside], spans[inside]
    places = nodes[near[:, :1]] + np.linspace(0, 1, PLACES + 2)[1:-1, None] * spans[:, None]  # pairs, places, 3
    nearest = np.asarray(surface.query(places)[1], np.int64)
    inside = (((places - vertices[nearest]) * normals[nearest]).sum(-1) < -1e-6 * lengths[:, None]).all(1)
    near, lengths = near[inside], lengths[inside]
    kept = np.zeros(len(near), bool)
    for end in (0, 1):  # the shortest ones of every node
        order = np.lexsort((lengths, near[:, end]))
        first = np.searchsorted(near[order, end], near[order, end])
        kept[order[np.arange(len(order)) - first < BRACES]] = True
    pairs = torch.from_numpy(np.sort(near[kept], 1).astype(np.int64))
    edges = torch.unique(torch.cat([control.edges, pairs]), dim=0)
    ends = control.nodes[edges]
    return replace(control, edges=edges, lengths=(ends[:, 1] - ends[:, 0]).norm(dim=-1).clamp(min=SHORTEST))


def surface_graph(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> csr_array:
    """Return the lengths of a mesh's edges as a symmetric matrix, with bridges between its components."""
    return bridge_components(vertices, mesh_edges(faces))


def point_graph(points: Float[np.ndarray, "v 3"]) -> csr_array:
    """Return the distances of points to their nearest neighbors as a symmetric connected matrix, for splats."""
    neighbors = min(POINT_NEIGHBORS, len(points) - 1)
    index = np.asarray(cKDTree(points).query(points, k=neighbors + 1)[1])[:, 1:]
    pairs = np.stack([np.repeat(np.arange(len(points)), neighbors), index.ravel()], 1)
    return bridge_components(points, np.unique(np.sort(pairs, 1), axis=0))


def bridge_components(points: Float[np.ndarray, "v 3"], pairs: Int[np.ndarray, "e 2"]) -> csr_array:
    """Join separate components of a graph by edges between their nearest points; return the matrix of lengths."""
    while True:
        graph = _lengths(points, pairs)
        found: tuple[int, NDArray[np.int32]] = connected_components(graph, directed=False)
        parts, labels = found
        if parts == 1:
            return graph
        pairs = np.unique(np.sort(np.concatenate([pairs, _bridges(points, labels, parts)]), 1), axis=0)


def spread_nodes(graph: csr_array, points: Float[np.ndarray, "v 3"], count: int) -> tuple[Int[np.ndarray, " m"], float]:
    """Choose points along the graph, each the farthest from those before it; also return the largest gap left."""
    selected = [int(np.linalg.norm(points - points.mean(0), axis=1).argmax())]
    nearest = graph_distances(graph, selected[:1])[0]
    while len(selected) < count:
        selected.append(int(nearest.argmax()))
        if nearest[selected[-1]] == 0:
            selected.pop()
            break
        nearest = np.minimum(nearest, graph_distances(graph, selected[-1:], float(nearest[selected[-1]]))[0])
    return np.array(selected), max(float(nearest.max()), 1e-9)


def graph_distances(
    graph: csr_array, sources: Sequence[int] | Int[np.ndarray, " m"], limit: float = np.inf
) -> Float[np.ndarray, "m v"]:
    """Return the distances from some points to all along the graph; infinity beyond the limit."""
    found: Float[np.ndarray, "m v"] = dijkstra(graph, directed=False, indices=np.asarray(sources), limit=limit)
    return found


def symmetric_matrix(pairs: Int[np.ndarray, "e 2"], values: Float[np.ndarray, " e"], count: int) -> csr_array:
    """Return values of the edges between so many nodes as a symmetric matrix."""
    ends = np.concatenate([pairs, pairs[:, ::-1]]).T
    return csr_array(coo_array((np.concatenate([values, values]), tuple(ends)), shape=(count, count)))


def _lengths(points: Float[np.ndarray, "v 3"], pairs: Int[np.ndarray, "e 2"]) -> csr_array:
    lengths = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1).clip(SHORTEST)  # 0 would be no edge
    return symmetric_matrix(pairs, lengths, len(points))


def _bridges(points: Float[np.ndarray, "v 3"], labels: Int[np.ndarray, " v"], parts: int) -> Int[np.ndarray, "e 2"]:
    """Return edges from every component but the largest to the nearest points of others."""
    sizes = np.bincount(labels, minlength=parts)
    order = np.argsort(sizes)
    nearest, distances = _nearest_elsewhere(points, labels, np.flatnonzero(labels != order[-1]))
    members = np.split(np.argsort(labels, kind="stable"), np.cumsum(sizes)[:-1])
    found = []
    for part in order[:-1]:
        inside = members[part]
        gaps, others = distances[inside], labels[nearest[inside]]
        for other in np.unique(others[gaps <= TOUCHING * gaps.min() + 1e-6]):
            rows = np.flatnonzero(others == other)
            rows = inside[rows[gaps[rows].argsort(kind="stable")[:BRIDGES]]]
            found.append(np.stack([rows, nearest[rows]], 1))
    return np.concatenate(found)


def _nearest_elsewhere(
    points: Float[np.ndarray, "v 3"], labels: Int[np.ndarray, " v"], selected: Int[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, " v"], Float[np.ndarray, " v"]]:
    """Return the nearest point with another label, and its distance, for selected points; infinity for others.

    Different labels differ in a bit, so two trees per bit are enough, whatever the number of labels.
    """
    nearest, distances = np.zeros(len(points), np.int64), np.full(len(points), np.inf)
    for bit in range(int(labels.max()).bit_length()):
        ones = (labels >> bit & 1).astype(bool)
        for outside in (np.flatnonzero(ones), np.flatnonzero(~ones)):
            inside = selected[ones[selected] != ones[outside[0]]]
            tree = cKDTree(points[outside], compact_nodes=False, balanced_tree=False)  # faster far from points
            found, index = map(np.asarray, tree.query(points[inside]))
            closer = found < distances[inside]
            distances[inside[closer]], nearest[inside[closer]] = found[closer], outside[index[closer]]
    return nearest, distances
