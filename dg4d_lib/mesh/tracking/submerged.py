"""Vertices that a motion pushes into another part of their surface, found with balls that fit inside it at rest.

Every vertex has the largest ball that touches it from inside and holds no vertex (shrinking balls, Ma et al. 2012). A
ball moves with the two places that it touches. A vertex is submerged if it lies in a ball of another part: one whose
places are far from it along the surface.
"""

from typing import NamedTuple, no_type_check

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array, csr_array
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from dg4d_lib.geometry.normals import vertex_normals
from dg4d_lib.kernels.compiling import njit
from dg4d_lib.mesh.models.control_graph import ControlGraph, build_control_graph, graph_distances, surface_graph
from dg4d_lib.mesh.neighbors import faces_to_vertices, grown
from dg4d_lib.mesh.tracking.elastic import ElasticBody

NODES = 300  # control nodes
LARGEST, SMALLEST = 0.5, 0.01  # radii of balls, world units: the first guess, and the smallest that count
SHRINKINGS = 30  # largest number of shrinking steps per ball
WIDE = 0.9  # least distance of both contact points of a ball, in radii: 53 degrees seen from its center
TOUCHING = 8  # vertices nearest to a center, the farthest of which from the ball's own vertex is its second place
FAR = 0.06  # world units: another part begins farther than this and half of a ball's circumference along the surface
OUTSIDE = 1.3  # radii: nodes nearer to the center at rest belong to the ball's own part
THINNER = 0.8  # least radius of a ball relative to a vertex's own ball: the thicker part decides the direction


class Submerged(NamedTuple):
    """Vertices inside other parts.

    Attributes:
        vertices: indices, ascending.
        balls: that each lies deepest in.
        depths: below the surface of the ball, world units.
    """

    vertices: Int[np.ndarray, " n"]
    balls: Int[np.ndarray, " n"]
    depths: Float[np.ndarray, " n"]


class InnerBalls:
    """Surface at rest with its inner balls.

    Attributes:
        body: the surface.
        control: nodes on it.
        node: nearest node of every vertex along the surface.
        blend: weights of the nodes at every vertex, "v m".
        ball_blend: weights of the nodes at the center of every ball, "b m".
        radii: of the balls, world units.
    """

    def __init__(self, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> None:
        """Prepare the search.

        Args:
            vertices: at rest, not split along seams.
            faces: counter-clockwise seen from outside.
        """
        self.body = ElasticBody(vertices, faces)
        self.control = build_control_graph(vertices, faces, NODES)
        nodes = self.control.nodes.double().numpy()
        along = graph_distances(surface_graph(vertices, faces), np.asarray(cKDTree(vertices).query(nodes)[1]))
        self.node = along.argmin(0)
        self.blend = _blend_matrix(self.control)
        normals = vertex_normals(torch.from_numpy(vertices).float(), torch.from_numpy(faces)).double().numpy()
        centers, radii = inner_balls(vertices, normals)
        own = np.flatnonzero(radii > SMALLEST)
        self._thickness, self.radii, self._centers = THINNER * radii, radii[own], centers[own]
        near = np.asarray(cKDTree(vertices).query(self._centers, TOUCHING)[1])
        farthest = np.linalg.norm(vertices[near] - vertices[own, None], axis=2).argmax(1)
        self._places = np.stack([own, near[np.arange(len(own)), farthest]])
        self.ball_blend = csr_array(0.5 * (self.blend[self._places[0]] + self.blend[self._places[1]]))
        far = (along[:, self._places].min(1) > np.pi * self.radii + FAR).T
        outside = cdist(self._centers, nodes) > OUTSIDE * self.radii[:, None]
        self._apart = np.ascontiguousarray(far & outside)

    def centers(self, moved: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "b 3"]:
        """Return the centers of the balls when the surface has moved."""
        rest, rotations = self.body.rest, self.body.rotations(moved)
        turned = np.einsum("kbij,kbj->kbi", rotations[self._places], self._centers - rest[self._places])
        centers: Float[np.ndarray, "b 3"] = (moved[self._places] + turned).mean(0)
        return centers

    def submerged(
        self, moved: Float[np.ndarray, "v 3"], centers: Float[np.ndarray, "b 3"], crossing: Bool[np.ndarray, " f"]
    ) -> Submerged:
        """Return the submerged vertices that hang together with a crossing of faces.

        Args:
            moved: vertices.
            centers: of the balls, as `centers` returns them or moved on with the surface.
            crossing: faces that cross others.
        """
        edges = self.body.edges
        start = np.flatnonzero(grown(faces_to_vertices(crossing, self.body.faces, len(moved)), edges, 1))
        balls, depths = np.full(len(moved), -1), np.zeros(len(moved))
        _flood(
            moved, start, edges.indptr, edges.indices, centers, self.radii, self._apart, self.node, self._thickness,
            balls, depths,
        )  # fmt: skip
        vertices = np.flatnonzero(balls >= 0)
        return Submerged(vertices, balls[vertices], depths[vertices])


def inner_balls(
    points: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"]
) -> tuple[Float[np.ndarray, "v 3"], Float[np.ndarray, " v"]]:
    """Return centers and radii of the largest balls that touch every point from inside and hold no other point.

    Args:
        points: of a closed surface.
        normals: unit length, outward; points without one get a ball of radius 0.
    """
    tree, radii = cKDTree(points), LARGEST * np.linalg.norm(normals, axis=1).round()
    for _ in range(SHRINKINGS):
        centers = points - radii[:, None] * normals
        distances, nearest = map(np.asarray, tree.query(centers))
        arms = points - points[nearest]
        along = np.einsum("vi,vi->v", normals, arms)
        through = np.einsum("vi,vi->v", arms, arms) / (2 * along).clip(1e-9)  # radius of the ball through both points
        wide = np.linalg.norm(arms, axis=1) > WIDE * through  # neighbors tell of noise alone
        held = (distances < radii * (1 - 1e-3)) & (along > 1e-6) & (through < radii) & wide
        if not held.any():
            break
        radii[held] = through[held]
    return points - radii[:, None] * normals, radii


def _blend_matrix(control: ControlGraph) -> csr_array:
    """Return the weights of the nodes at every vertex as a matrix."""
    indices, weights = control.indices.numpy(), control.weights.double().numpy()
    rows = np.repeat(np.arange(len(indices)), indices.shape[1])
    return coo_array((weights.ravel(), (rows, indices.ravel())), shape=(len(indices), len(control.nodes))).tocsr()


@njit(cache=True, nogil=True)
@no_type_check
def _flood(points, start, starts, neighbors, centers, radii, apart, node, thickness, balls, depths):
    """Write the ball of another part that a point lies deepest in, from the starting points as far as one is found."""
    seen = np.zeros(len(points), np.bool_)
    queue = np.empty(len(points), np.int64)
    waiting = len(start)
    queue[:waiting] = start
    seen[start] = True
    while waiting:
        waiting -= 1
        p = queue[waiting]
        for b in range(len(centers)):
            radius = radii[b]
            x = points[p, 0] - centers[b, 0]
            if abs(x) >= radius or radius < thickness[p] or not apart[b, node[p]]:
                continue
            y, z = points[p, 1] - centers[b, 1], points[p, 2] - centers[b, 2]
            depth = radius - np.sqrt(x * x + y * y + z * z)
            if depth > depths[p]:
                balls[p], depths[p] = b, depth
        if balls[p] >= 0:
            for k in range(starts[p], starts[p + 1]):
                if not seen[neighbors[k]]:
                    seen[neighbors[k]] = True
                    queue[waiting] = neighbors[k]
                    waiting += 1
