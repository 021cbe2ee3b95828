"""Placement and duration of a model in motion, changed without a new fit."""

import numpy as np

from dg4d_lib.assets.formats.gltf import GlbReader, GltfDocument
from dg4d_lib.assets.placement import Placement


def place_moving_glb(content: bytes, placement: Placement, slowdown: float) -> bytes:
    """Move a model in motion, and change its duration; its keys and all else are kept.

    Args:
        content: GLB of `write_moving_glb`; the first root node of its scene has a matrix that places the model.
        placement: from the coordinates of the fit to meters.
        slowdown: factor on the times of the keys.

    Returns:
        The GLB.

    Raises:
        BadInput: the file is corrupt.
    """
    reader = GlbReader(content)
    tree, binary = reader.tree, bytearray(reader.binary)
    root, *_ = tree["scenes"][tree.get("scene", 0)]["nodes"]
    columns = np.array(tree["nodes"][root]["matrix"]).reshape(4, 4)
    columns[:, :3] *= placement.scale
    columns[3, :3] += placement.translation
    tree["nodes"][root]["matrix"] = columns.ravel().tolist()
    for index in {sampler["input"] for animation in tree["animations"] for sampler in animation["samplers"]}:
        times = (reader.accessor(index) * slowdown).astype("<f4")
        accessor = tree["accessors"][index]
        start = tree["bufferViews"][accessor["bufferView"]]["byteOffset"]
        binary[start : start + times.nbytes] = times.tobytes()
        accessor.update(min=times.min(0).tolist(), max=times.max(0).tolist())
    document = GltfDocument({})
    document.tree, document.binary = tree, binary
    return document.to_bytes()
