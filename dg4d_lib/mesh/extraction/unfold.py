"""Removal of folds and self-intersections from a surface by smoothing around them."""

import numpy as np
from jaxtyping import Bool, Float, Int

from dg4d_lib.mesh.folds import DefectFinder
from dg4d_lib.mesh.neighbors import edge_graph, faces_to_vertices, grown, neighbor_means

ROUNDS = 24  # at most; smoothing also shrinks, which makes new defects in the end, so the best round counts
WIDER = 6  # rounds after which one more ring of neighbors is smoothed
SWEEPS = 3  # averagings with the neighbors per round
STEP = 0.5  # share of the way to the mean of the neighbors


def unfold(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "v 3"]:
    """Return vertices without folds and self-intersections, as far as smoothing around them removes them.

    Args:
        vertices: welded.
        faces: counter-clockwise seen from outside; their order and number stay.
    """
    edges = edge_graph(faces, len(vertices))
    mean_of_neighbors, finder = neighbor_means(edges), DefectFinder(faces)
    smooth = vertices.astype(np.float64)
    fewest, best = len(faces) + 1, smooth
    moved: Bool[np.ndarray, " v"] | None = None
    for number in range(ROUNDS):
        defective = finder.defective(smooth, moved)
        if defective.sum() < fewest:
            fewest, best = defective.sum(), smooth.copy()
        if fewest == 0:
            break
        around = grown(faces_to_vertices(defective, faces, len(smooth)), edges, 1 + number // WIDER)
        moved = around if moved is None else moved | around
        here = np.flatnonzero(around)
        means_here = mean_of_neighbors[here]
        for _ in range(SWEEPS):
            smooth[here] += STEP * (means_here @ smooth - smooth[here])
    return best.astype(vertices.dtype)
