"""Skeletons of users' models: joints, and the surface that they move by linear blend skinning."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array
from torch import Tensor

from dg4d_lib.mesh.models.control_graph import SHORTEST, ControlGraph
from dg4d_lib.mesh.models.surface_cloud import SurfaceCloud

INFLUENCES = 8  # joints that move a point, the heaviest ones
SOME = 1e-6  # share of all weights from which a joint turns for itself
ROWS = 8192  # rows of weights per dense batch


@dataclass(frozen=True)
class Skeleton:
    """Joints at rest, and the vertices that they move.

    Attributes:
        places: joints in the coordinates of the model.
        parents: parent of every joint, which comes before it; -1 for none.
        weights: of the joints at the vertices of the model, sparse; rows sum to 1, or to 0 where no joint moves them.
    """

    places: Float[np.ndarray, "j 3"]
    parents: Int[np.ndarray, " j"]
    weights: csr_array


@dataclass(frozen=True)
class JointGraph:
    """Joints as control nodes: the first node, at their center, is the parent of all roots and moves unweighted points.

    Attributes:
        graph: nodes, the points that they move, and the edges from joints to their parents.
        parents: parent of every node, which comes before it; -1 for the first one.
        turning: nodes that rotate; the others, such as helper joints, follow their parents.
    """

    graph: ControlGraph
    parents: Int[np.ndarray, " m"]
    turning: Bool[Tensor, " m"]

    def of(self, rows: Int[Tensor, " n"]) -> "JointGraph":
        """Return the same joints with the weights of some of the points."""
        return replace(self, graph=self.graph.of(rows))


def joint_graph(
    skeleton: Skeleton, surface: SurfaceCloud, faces: Int[np.ndarray, "f 3"], matrix: Float[np.ndarray, "4 4"]
) -> JointGraph:
    """Return the joints of a placed model, and their weights at the vertices of its subdivided surface.

    Args:
        skeleton: in the coordinates of the model.
        surface: of the model.
        faces: triangles of the model, which the surface was subdivided from.
        matrix: from the coordinates of the model to the world.
    """
    weights = _at_fine_vertices(skeleton.weights, surface, faces)
    indices, shares = _heaviest(weights)
    places = skeleton.places @ matrix[:3, :3].T + matrix[:3, 3]
    nodes = torch.from_numpy(np.concatenate([places.mean(0, keepdims=True), places]).astype(np.float32))
    parents = np.concatenate([[-1], skeleton.parents + 1])
    edges = torch.from_numpy(np.stack([parents[1:], np.arange(1, len(parents))], 1))
    spans = nodes[edges[:, 1]] - nodes[edges[:, 0]]
    graph = ControlGraph(nodes, indices, shares, edges, spans.norm(dim=-1).clamp(min=SHORTEST))
    own = np.asarray(weights.sum(0)).ravel()
    turning = torch.from_numpy(np.concatenate([[True], own > SOME * own.sum()]))
    return JointGraph(graph, parents, turning)


def _at_fine_vertices(weights: csr_array, surface: SurfaceCloud, faces: Int[np.ndarray, "f 3"]) -> csr_array:
    """Return the weights at subdivided vertices: interpolated in a triangle of the model that has them."""
    fine = surface.fine
    count, first = len(fine.vertices), np.unique(fine.faces.ravel(), return_index=True)
    vertices, corner = first[0], first[1]
    shares = fine.barycentrics.reshape(-1, 3)[corner]
    corners = faces[fine.sources[corner // 3]]
    entries = (np.repeat(vertices, 3), corners.ravel())
    return csr_array(csr_array((shares.ravel(), entries), shape=(count, weights.shape[0])) @ weights)


def _heaviest(weights: csr_array) -> tuple[Int[Tensor, "v k"], Float[Tensor, "v k"]]:
    """Return the nodes that move every point, and their weights; node 0 moves points without weights."""
    count = min(INFLUENCES, weights.shape[1])
    indices, shares = [], []
    for start in range(0, weights.shape[0], ROWS):
        dense = weights[start : start + ROWS].toarray()
        selected = np.argpartition(-dense, count - 1, axis=1)[:, :count]
        share = np.take_along_axis(dense, selected, 1)
        total = share.sum(1, keepdims=True)
        free = total[:, 0] < SOME
        nodes, share = selected + 1, share / np.where(total < SOME, 1, total)
        nodes[free, 0], share[free] = 0, np.eye(count)[0]  # all nodes of a point differ, as a graph needs it
        indices.append(nodes)
        shares.append(share)
    return torch.from_numpy(np.concatenate(indices)), torch.from_numpy(np.concatenate(shares).astype(np.float32))
