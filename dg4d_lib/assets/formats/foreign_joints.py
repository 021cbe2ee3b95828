"""Skeleton of a GLB of another program at rest, with the vertices that it moves."""

import numpy as np
from jaxtyping import Float
from scipy.sparse import csr_array

from dg4d_lib.assets.formats.foreign_glb import ForeignGlb
from dg4d_lib.assets.formats.foreign_nodes import global_matrices, mesh_attributes, parents_of, skin_of, skin_weights
from dg4d_lib.assets.formats.foreign_skeleton import MOST_JOINTS, joints_and_movers
from dg4d_lib.mesh.models.skeleton import Skeleton

MOSTLY = 0.8  # share of the vertices from which joints move the model, and not a flag on it


def read_skeleton(glb: ForeignGlb) -> Skeleton | None:
    """Return the skeleton of a model; None if it has none, more than 256 joints, or one that moves little of it."""
    tree = glb.reader.tree
    skins = [skin_of(tree, piece.node, piece.primitive) for piece in glb.pieces]
    rest = global_matrices(tree)
    used = {joint for skin in skins if skin for joint in skin["joints"]}
    joints, movers, above = joints_and_movers(rest, parents_of(tree, rest), used)
    if not 0 < len(joints) <= MOST_JOINTS:
        return None
    entries: list[Float[np.ndarray, "n 3"]] = []  # row, column and value of the weights
    start = 0
    for piece, skin in zip(glb.pieces, skins, strict=True):
        rows = np.arange(start, start := start + len(piece.local))
        if skin is not None:
            indices, weights = skin_weights(glb.reader, mesh_attributes(tree, piece.node, piece.primitive))
            columns = np.array([movers[joint] for joint in skin["joints"]])[indices]
            entries.append(np.stack([np.repeat(rows, weights.shape[1]), columns.ravel(), weights.ravel()], 1))
        elif piece.node in movers:
            entries.append(np.stack([rows, np.full(len(rows), movers[piece.node]), np.ones(len(rows))], 1))
    listed = np.concatenate(entries)
    entry = (listed[:, 0].astype(int), listed[:, 1].astype(int))
    sparse = csr_array((listed[:, 2], entry), shape=(start, len(joints)))  # adds what is listed twice
    if np.count_nonzero(sparse.sum(1) > 0) < MOSTLY * start:
        return None
    places = np.stack([rest[joint][:3, 3] for joint in joints])
    if not np.isfinite(places).all():
        return None
    return Skeleton(places, np.array(above), sparse)
