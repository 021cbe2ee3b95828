"""Repair of faces that a motion flips."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_array

from dg4d_lib.mesh.folds import area_normals
from dg4d_lib.mesh.neighbors import edge_graph, faces_to_vertices, graph_laplacian, grown, screened_factors

RINGS = (2, 4, 8, 16, 32, 64, 128)  # relaxed rings of vertices around flipped faces, one attempt each
NEAR, SLIVER = 8, 0.1  # largest relaxed region, rings, for flipped slivers below this area, relative to the median
SHORTEST = 1e-3  # edge length at which the stiffness is clamped, relative to the median
LEAST_OWN = 1e-6  # weight of the own motion of vertices at flipped faces, against 1 per edge


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

    Around flipped faces, turn and displacement are those of a membrane that is drawn to the motion of the other
    vertices, the less the wider it is; where it flips faces, too, a wider one is tried. Slivers may stay flipped:
    nobody sees them, and the surface should not stiffen far around for them.

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
    laplacian = graph_laplacian(_stiff(edges, rest))
    affine = np.concatenate([rotations.reshape(-1, 9), moved - np.einsum("vij,vj->vi", rotations, rest)], 1)
    fewest, best, region = int(wrong.sum()), moved, np.zeros(len(rest), bool)
    areas = np.linalg.norm(area_normals(rest, faces), axis=1)
    broad = areas > SLIVER * np.median(areas)
    at_first, own = faces_to_vertices(wrong, faces, len(rest)), np.ones(len(rest))
    for rings in RINGS:
        near = grown(faces_to_vertices(wrong, faces, len(rest)), edges, rings)
        own[near], region = 1 / rings**2, region | near
        spanned = _spanned(affine, laplacian, region, np.where(at_first, LEAST_OWN, own))
        turns, attempt = spanned[:, :9].reshape(-1, 3, 3), moved.copy()
        attempt[region] = np.einsum("vij,vj->vi", turns[region], rest[region]) + spanned[region, 9:]
        wrong = faces_against_rotations(rest, attempt, faces, turns)
        if wrong.sum() < fewest:
            fewest, best = int(wrong.sum()), attempt
        if fewest == 0 or region.all() or (rings >= NEAR and not (wrong & broad).any()):
            break
    return best, fewest


def _stiff(edges: csr_array, rest: Float[np.ndarray, "v 3"]) -> csr_array:
    """Return the adjacency with a weight by the inverse square of the length, 1 for the median: slivers stay stiff."""
    pairs = edges.tocoo()
    lengths = np.linalg.norm(rest[pairs.row] - rest[pairs.col], axis=1)
    lengths /= max(float(np.median(lengths)), 1e-30)
    return csr_array((lengths.clip(SHORTEST) ** -2, (pairs.row, pairs.col)), shape=edges.shape)


def _spanned(
    values: Float[np.ndarray, "v c"],
    laplacian: csr_array,
    region: Bool[np.ndarray, " v"],
    own: Float[np.ndarray, " v"],
) -> Float[np.ndarray, "v c"]:
    """Return values that are smooth in a region and drawn to the given ones by `own`; those outside stay."""
    here, outside = np.flatnonzero(region), np.flatnonzero(~region)
    rows = laplacian[here]
    wanted = own[here, None] * values[here] - rows[:, outside] @ values[outside]
    spanned = values.copy()
    spanned[here] = screened_factors(rows[:, here], own[here]).solve(wanted)
    return spanned
