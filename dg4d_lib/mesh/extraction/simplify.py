"""Levels of detail of a tracked mesh: fewer triangles, same texture and same motion.

Quadric error metrics (Garland and Heckbert 1997; with attributes: Hoppe 1999) from meshoptimizer. Edges collapse into
one of their endpoints, so the remaining vertices are a subset of the old ones: texture coordinates, seams and offsets
stay exactly as they were, and all levels share one texture. The motion of a vertex is an attribute beside its position.
"""

from ctypes import c_float, c_size_t
from importlib import import_module
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.mesh.textured import TexturedMesh

MODES = 8  # principal components of the motion
MOTION_WEIGHT = 4.0  # weight of the root mean square motion error, relative to the surface distance at rest
NO_LIMIT = 1e9  # error bound that is never reached, so the number of triangles decides


def simplify_mesh(
    mesh: TexturedMesh, offsets: Float[Tensor, "t v 3"], triangles: int
) -> tuple[TexturedMesh, Float[Tensor, "t w 3"]]:
    """Reduce a mesh to at most this many triangles; return it with its offsets.

    Closed meshes stay closed along their seams; parts may come to touch. Seams limit the reduction to some hundred
    triangles; below that, the result is the smallest possible. A mesh that is small enough is returned unchanged.

    Args:
        mesh: split along the seams of its texture.
        offsets: added to its vertices at every frame; zeros for a static mesh.
        triangles: target number, at least 1.

    Raises:
        BadInput: `triangles` is below 1, or the mesh holds numbers that are not finite.
        BackendUnavailable: meshoptimizer is missing.
    """
    if triangles < 1:
        raise BadInput(f"a level of detail needs at least 1 triangle; {triangles} requested: raise pack.lods")
    if not bool(mesh.vertices.isfinite().all()) or not bool(offsets.isfinite().all()):
        raise BadInput("the mesh holds numbers that are not finite and cannot be simplified; extract it again")
    if len(mesh.faces) <= triangles:
        return mesh, offsets
    try:
        meshoptimizer: Any = import_module("meshoptimizer")  # optional package; its type annotations are wrong
    except ImportError as error:
        raise BackendUnavailable(
            "levels of detail need the package meshoptimizer; run `deploy/install.sh meshopt`, or leave pack.lods empty"
        ) from error
    vertices = np.ascontiguousarray(mesh.vertices.numpy(force=True), np.float32)
    indices = mesh.faces.numpy(force=True).astype(np.uint32).ravel()
    motion = _motion_modes(offsets) / meshoptimizer.simplify_scale(vertices)  # the library scales positions the same
    kept = np.zeros_like(indices)
    count = meshoptimizer.simplify_with_attributes(  # its binding declares no argument types, so pass ctypes numbers
        kept,
        indices,
        vertices,
        np.ascontiguousarray(motion, np.float32),
        np.full(MODES, MOTION_WEIGHT, np.float32),
        index_count=c_size_t(indices.size),
        vertex_count=c_size_t(len(vertices)),
        vertex_positions_stride=c_size_t(vertices.strides[0]),
        vertex_attributes_stride=c_size_t(MODES * np.float32().nbytes),
        attribute_count=c_size_t(MODES),
        target_index_count=c_size_t(3 * triangles),
        target_error=c_float(NO_LIMIT),
    )
    used, faces = np.unique(kept[:count], return_inverse=True)
    remaining = torch.from_numpy(used.astype(np.int64)).to(mesh.vertices.device)
    corners = torch.from_numpy(faces.reshape(-1, 3)).to(mesh.faces)
    return mesh.select(remaining, corners), offsets[:, remaining]


def _motion_modes(offsets: Float[Tensor, "t v 3"]) -> NDArray[np.float64]:
    """Return the largest principal components of every vertex's motion, world units, padded with zeros.

    The distance between two rows is the root mean square distance of the motions over time.
    """
    paths = offsets.double().movedim(0, 1).flatten(1).numpy(force=True)
    paths = (paths - paths.mean(0)) / np.sqrt(max(1, len(offsets)))
    _, axes = np.linalg.eigh(paths.T @ paths)
    modes = paths @ axes[:, ::-1][:, :MODES]
    return np.pad(modes, ((0, 0), (0, MODES - modes.shape[1])))
