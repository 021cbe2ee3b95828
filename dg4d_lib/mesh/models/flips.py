"""Repair of faces that a motion turns inside out."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array, csr_array

ROUNDS = 40  # smoothing steps at most
RINGS = 1  # rings of vertices by which the smoothed region grows in a step


def flipped_faces(
    rest: Float[np.ndarray, "v 3"],
    moved: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    rotations: Float[np.ndarray, "v 3 3"],
) -> Bool[np.ndarray, " f"]:
    """Return true for faces whose normal points away from that of the rest pose, turned with their first corner."""
    before, after = _normals(rest, faces), _normals(moved, faces)
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
    wrong = flipped_faces(rest, moved, faces, rotations)
    if not wrong.any():
        return moved, 0
    mean = _neighbor_means(faces, len(rest))
    turns = rotations.copy()
    shifts = moved - np.einsum("vij,vj->vi", turns, rest)
    moved = moved.copy()
    region = np.zeros(len(rest), bool)
    for _ in range(ROUNDS):
        region[faces[wrong]] = True
        for _ in range(RINGS):
            region |= (mean @ region.astype(np.float64)) > 0
        affine = np.concatenate([turns.reshape(-1, 9), shifts], 1)
        affine[region] = 0.5 * (affine[region] + (mean @ affine)[region])
        turns, shifts = affine[:, :9].reshape(-1, 3, 3), affine[:, 9:]
        moved[region] = (np.einsum("vij,vj->vi", turns, rest) + shifts)[region]
        wrong = flipped_faces(rest, moved, faces, turns)
        if not wrong.any():
            break
    return moved, int(wrong.sum())


def _normals(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 3"]:
    corners = vertices[faces]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _neighbor_means(faces: Int[np.ndarray, "f 3"], count: int) -> csr_array:
    """Return the matrix that averages the neighbors of every vertex."""
    pairs = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1), axis=0)
    ends = np.concatenate([pairs, pairs[:, ::-1]]).T
    graph = csr_array(coo_array((np.ones(ends.shape[1]), tuple(ends)), shape=(count, count)))
    degree = np.maximum(np.asarray(graph.sum(axis=1)).ravel(), 1)
    return csr_array(graph.multiply(1 / degree[:, None]))
