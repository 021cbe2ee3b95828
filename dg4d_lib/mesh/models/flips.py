"""Repair of faces that a motion turns inside out."""

import numpy as np
from jaxtyping import Bool, Float, Int

from dg4d_lib.mesh.folds import area_normals
from dg4d_lib.mesh.neighbors import edge_graph, grown, neighbor_means

ROUNDS = 120  # of smoothing, at most
SWEEPS = 3  # averagings with the neighbors per round
WIDER = 2  # rounds after which the smoothed region grows by a ring of vertices


def faces_against_rotations(
    rest: Float[np.ndarray, "v 3"],
    moved: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    rotations: Float[np.ndarray, "v 3 3"],
) -> Bool[np.ndarray, " f"]:
    """Mark faces whose normal points away from that of the rest pose, turned with their first corner."""
    before, after = area_normals(rest, faces), area_normals(moved, faces)
    expected = np.einsum("fij,fj->fi", rotations[faces[:, 0]], before)
    solid = np.linalg.norm(before, axis=1) > 1e-7 * np.linalg.norm(before, axis=1).max(initial=1e-30)
    return solid & (np.einsum("fi,fi->f", expected, after) < 0)


def unflip(
    rest: Float[np.ndarray, "v 3"],
    moved: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    rotations: Float[np.ndarray, "v 3 3"],
) -> tuple[Float[np.ndarray, "v 3"], int]:
    """Return the vertices without flipped faces, and the number of faces that stay flipped.

    Around flipped faces, the displacements from the turned rest pose are averaged with those of the neighbors, until
    the surface moves like a stiffer one there.

    Args:
        rest: vertices at rest.
        moved: vertices at one frame.
        faces: indices into the vertices.
        rotations: blended rotations of the vertices at this frame.
    """
    wrong = faces_against_rotations(rest, moved, faces, rotations)
    if not wrong.any():
        return moved, 0
    edges = edge_graph(faces, len(rest))
    mean_of_neighbors = neighbor_means(edges)
    affine = np.concatenate([rotations.reshape(-1, 9), moved - np.einsum("vij,vj->vi", rotations, rest)], 1)
    moved, region = moved.copy(), np.zeros(len(rest), bool)
    for number in range(ROUNDS):
        region[faces[wrong]] = True
        if number % WIDER == 0:
            region = grown(region, edges, 1)
        here = np.flatnonzero(region)
        means_here = mean_of_neighbors[here]
        for _ in range(SWEEPS):
            affine[here] = 0.5 * (affine[here] + means_here @ affine)
        turns, shifts = affine[:, :9].reshape(-1, 3, 3), affine[:, 9:]
        moved[here] = np.einsum("vij,vj->vi", turns[here], rest[here]) + shifts[here]
        wrong = faces_against_rotations(rest, moved, faces, turns)
        if not wrong.any():
            break
    return moved, int(wrong.sum())
