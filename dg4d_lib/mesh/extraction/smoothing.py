"""Smoothing of surfaces, and of the bumps that the density of Gaussians leaves outside outlines of the input view."""

import numpy as np
import torch
from jaxtyping import Float, Float64, Int

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.geometry.normals import vertex_normals
from dg4d_lib.mesh.folds import DefectFinder
from dg4d_lib.mesh.neighbors import edge_graph, faces_to_vertices, grown, neighbor_means

FACING = 0.5  # cosine of normal and line of sight of the input camera from which a vertex is smoothed fully
ATTEMPTS, RINGS = 4, 4  # thin sheets that smoothing folds or crosses stay as they are, with rings of vertices around
INWARDS, OUTWARDS = 0.5, 0.53  # shares of the way to the mean of the neighbors, and back (Taubin 1995)


def taubin_smooth(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    steps: int,
    share: float | Float[np.ndarray, "v 1"] = 1.0,
) -> Float64[np.ndarray, "v 3"]:
    """Smooth a mesh with alternating inward and outward steps, which keep its volume (Taubin 1995).

    Args:
        vertices: any units; those of no face stay.
        faces: indices into the vertices.
        steps: pairs of an inward and an outward step.
        share: of a whole step that a vertex takes, in [0, 1].
    """
    edges = edge_graph(faces, len(vertices))
    mean = neighbor_means(edges)
    isolated = (edges.sum(axis=1) == 0)[:, None]
    points = vertices.astype(np.float64)
    for _ in range(steps):
        for length in (INWARDS, -OUTWARDS):
            points = np.where(isolated, points, points + share * length * (mean @ points - points))
    return points


def smooth_bumps(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], steps: int
) -> Float[np.ndarray, "v 3"]:
    """Return vertices without bumps; the surface neither shrinks nor moves where the input view shows its outline.

    Args:
        vertices: of a surface of nearly equal edges, world units.
        faces: counter-clockwise seen from outside.
        steps: pairs of Taubin steps.
    """
    if steps == 0:
        return vertices
    edges, finder = edge_graph(faces, len(vertices)), DefectFinder(faces)
    sound = ~finder.defective(vertices)
    normals = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(faces)).numpy()
    sight = OrbitCamera().viewmat()[2, :3].numpy()
    share = np.minimum(np.abs(normals @ sight) / FACING, 1)[:, None]
    for _ in range(ATTEMPTS):
        smooth = taubin_smooth(vertices, faces, steps, share)
        damaged = finder.defective(smooth) & sound
        if not damaged.any():
            break
        share[grown(faces_to_vertices(damaged, faces, len(vertices)), edges, RINGS)] = 0
    return smooth.astype(vertices.dtype)
