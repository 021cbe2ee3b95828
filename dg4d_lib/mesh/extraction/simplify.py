"""Fewer triangles for the same texture and the same motion: levels of detail.

Quadric error metrics (Garland and Heckbert 1997; with attributes: Hoppe 1999) by meshoptimizer. Edges collapse into
one of their ends, so the vertices that are left are some of the old ones: texture coordinates, seams and offsets stay
exactly what they were, and all levels share one texture. How a vertex moves is an attribute beside its place.
"""

from ctypes import c_float, c_size_t
from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from dg4d_lib.errors import BackendUnavailable, BadInput
from dg4d_lib.mesh.textured import TexturedMesh

MODES = 8  # principal components of the motion that count
MOTION_WEIGHT = 4.0  # of their root mean square over time, against the distance of surfaces at rest
NO_LIMIT = 1e9  # error at which to stop: the number of triangles decides


def simplified(
    mesh: TexturedMesh, offsets: Float[Tensor, "t v 3"], triangles: int
) -> tuple[TexturedMesh, Float[Tensor, "t w 3"]]:
    """A mesh of at most this many triangles, and its offsets.

    Closed meshes stay closed along their seams; parts may come to touch. Seams set a lower bound to what can be
    reached, some hundred triangles; then the result is as small as it gets. A mesh that is small enough comes back as
    it is.

    Args:
        mesh: split at the seams of its texture.
        offsets: what is added to its vertices at every frame; zeros for a mesh that does not move.
        triangles: wanted, at least 1.

    Raises:
        BadInput: less than one triangle is wanted, or numbers are not finite.
        BackendUnavailable: meshoptimizer is missing.
    """
    if triangles < 1:
        raise BadInput(f"a level of detail needs at least one triangle; asked for {triangles}")
    if not bool(mesh.vertices.isfinite().all()) or not bool(offsets.isfinite().all()):
        raise BadInput("a mesh with numbers that are not finite cannot be simplified")
    if len(mesh.faces) <= triangles:
        return mesh, offsets
    try:
        meshoptimizer: Any = import_module("meshoptimizer")  # an optional package, whose types are not to be trusted
    except ImportError as error:
        raise BackendUnavailable(
            "levels of detail need the package meshoptimizer; run `deploy/install.sh meshopt`, or leave pack.lods empty"
        ) from error
    vertices = np.ascontiguousarray(mesh.vertices.numpy(force=True), np.float32)
    indices = mesh.faces.numpy(force=True).astype(np.uint32).ravel()
    ways = _modes(offsets) / meshoptimizer.simplify_scale(vertices)  # as the library scales places
    kept = np.zeros_like(indices)
    count = meshoptimizer.simplify_with_attributes(  # it declares no types to C, so every number brings its own
        kept,
        indices,
        vertices,
        np.ascontiguousarray(ways, np.float32),
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
    left = torch.from_numpy(used.astype(np.int64)).to(mesh.vertices.device)
    corners = torch.from_numpy(faces.reshape(-1, 3)).to(mesh.faces)
    return replace(mesh, vertices=mesh.vertices[left], faces=corners, uvs=mesh.uvs[left]), offsets[:, left]


def _modes(offsets: Float[Tensor, "t v 3"]) -> NDArray[np.float64]:
    """The motion of every vertex in few numbers, world units: distances between rows are root mean squares over time.

    They are its largest principal components, or zeros where it has fewer.
    """
    ways = offsets.double().movedim(0, 1).flatten(1).numpy(force=True)
    ways = (ways - ways.mean(0)) / np.sqrt(max(1, len(offsets)))
    _, axes = np.linalg.eigh(ways.T @ ways)
    modes = ways @ axes[:, ::-1][:, :MODES]
    return np.pad(modes, ((0, 0), (0, MODES - modes.shape[1])))
