"""Folds and self-intersections of a surface: smoothing removes them; steps that would make new ones are shortened."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from scipy.sparse import csr_array

from dg4d_lib.mesh.folds import DefectFinder
from dg4d_lib.mesh.neighbors import edge_graph, faces_to_vertices, grown, neighbor_means

ROUNDS = 24  # largest number; smoothing shrinks, which makes new defects in the end, so the best round is kept
WIDER = 6  # rounds after which one more ring of neighbors is smoothed
SWEEPS = 3  # averagings with the neighbors per round
STEP = 0.5  # share of the way to the mean of the neighbors
ATTEMPTS, RINGS = 20, 3  # attempts to avoid new defects, and attempts after which the affected region grows by a ring
SHORTER = 0.5  # factor on steps near new defects in the first half of the attempts; later such steps are undone


def unfold(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "v 3"]:
    """Return vertices without folds and self-intersections, as far as smoothing around them removes them.

    Args:
        vertices: welded.
        faces: counter-clockwise seen from outside; their order and number stay.
    """
    edges = edge_graph(faces, len(vertices))
    mean_of_neighbors, finder = neighbor_means(edges), DefectFinder(faces)
    smooth = vertices.astype(np.float64)
    defective = finder.defective(smooth)
    fewest, best = defective.sum(), smooth
    for number in range(ROUNDS - 1):
        if fewest == 0:
            break
        around = grown(faces_to_vertices(defective, faces, len(smooth)), edges, 1 + number // WIDER)
        here, before = np.flatnonzero(around), smooth
        means_here, smooth = mean_of_neighbors[here], smooth.copy()
        for _ in range(SWEEPS):
            smooth[here] += STEP * (means_here @ smooth - smooth[here])
        defective = finder.updated(defective, before, smooth)
        if defective.sum() < fewest:
            fewest, best = defective.sum(), smooth
    return best.astype(vertices.dtype)


def without_new_defects(
    start: Float[np.ndarray, "v 3"],
    moved: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    edges: csr_array,
    defective: Callable[[Float[np.ndarray, "v 3"], Bool[np.ndarray, " f"] | None], Bool[np.ndarray, " f"]],
) -> Float64[np.ndarray, "v 3"]:
    """Return the moved vertices; near new defects they move less, ring by ring, until none is new.

    Args:
        start: vertices, which may have defects.
        moved: the same vertices after a step.
        faces: counter-clockwise seen from outside.
        edges: adjacency of the vertices.
        defective: marks the faces with defects in a pose, of all or at least of those near (`DefectFinder.defective`).
    """
    before, near = defective(start, None), None
    steps = moved - start.astype(np.float64)
    share = np.ones((len(start), 1))
    for attempt in range(ATTEMPTS):
        kept = start + share * steps
        early = attempt < ATTEMPTS // 2
        present = defective(kept, near if early else None)
        new = present & ~before
        if not new.any():
            return kept
        # later around old ones, too: a new one may cross a face that crossed others before
        around = grown(faces_to_vertices(new if early else present, faces, len(start)), edges, 1 + attempt // RINGS)
        share[around] *= SHORTER if early else 0
        near = grown(around, edges, 1)[faces].any(1)  # other new defects are nearby; flips show one ring farther
    return start.astype(np.float64)
