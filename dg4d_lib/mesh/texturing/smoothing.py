"""Smoothing of surfaces, which keeps their volume."""

import numpy as np
from jaxtyping import Float, Float64, Int

from dg4d_lib.mesh.neighbors import edge_graph, neighbor_means

INWARDS, OUTWARDS = 0.5, 0.53  # shares of the way to the mean of the neighbors, and back (Taubin 1995)


def taubin_smooth(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], steps: int
) -> Float64[np.ndarray, "v 3"]:
    """Smooth a mesh with alternating inward and outward steps, which keep its volume (Taubin 1995).

    Args:
        vertices: any units; those of no face stay.
        faces: indices into the vertices.
        steps: pairs of an inward and an outward step.
    """
    edges = edge_graph(faces, len(vertices))
    mean = neighbor_means(edges)
    isolated = (edges.sum(axis=1) == 0)[:, None]
    points = vertices.astype(np.float64)
    for _ in range(steps):
        for length in (INWARDS, -OUTWARDS):
            points = np.where(isolated, points, points + length * (mean @ points - points))
    return points
