"""Projection of skinned vertices onto the density isosurface of each frame.

Skinning follows only rigid motion; Gaussians also grow, shrink and separate. Each vertex moves along its normal to the
nearest point where the density of the frame falls below the level, if there is one within reach.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import map_coordinates
from torch import Tensor

from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.normals import vertex_normals
from dg4d_lib.mesh.extraction.density import DensityField, density_field
from dg4d_lib.mesh.fairing import bump_filter
from dg4d_lib.settings import MeshSettings

LEVEL_FACTOR = 1.4  # factor of the level; a mesh that joins separating limbs is too thick over the whole motion
REACH = 3.0  # longest step of a vertex, in cells of the density field
STEPS = 13  # samples along the normal, from inside to outside
PASSES = 3  # projections, each starting from the previous result


def project_to_isosurface(
    vertices: Float[Tensor, "v 3"],
    offsets: Float[Tensor, "t v 3"],
    faces: Int[Tensor, "f 3"],
    states: Gaussians,
    level: float,
    settings: MeshSettings,
) -> Float[Tensor, "t v 3"]:
    """Return the offsets, corrected along the normals of the moved mesh.

    Args:
        vertices: in the reference frame, not split along seams.
        offsets: of the skinned vertices at every frame.
        faces: counter-clockwise seen from outside.
        states: the cloud at every frame (fields "t n 3").
        level: density of the surface in the reference frame; vertices are projected to 1.4 times this level.
        settings: mesh settings.
    """
    smooth = bump_filter(vertices.numpy(), faces.numpy(), settings.fairing)
    corrected = offsets.clone()
    for frame in range(len(offsets)):
        field = density_field(states.at(frame), settings)
        for _ in range(PASSES):
            moved = vertices + corrected[frame]
            normals = vertex_normals(moved, faces)
            distances = smooth(steps_to_isosurface(field, moved.numpy(), normals.numpy(), LEVEL_FACTOR * level))
            corrected[frame] += torch.from_numpy(distances.astype(np.float32))[:, None] * normals
    return corrected


def steps_to_isosurface(
    field: DensityField, positions: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"], level: float
) -> Float[np.ndarray, " v"]:
    """Return the signed distance of every vertex along its normal to the isosurface; 0 where none is within reach."""
    steps = np.linspace(-REACH, REACH, STEPS) * field.cell
    samples = positions[:, None] + steps[:, None] * normals[:, None]
    cells = (samples - field.origin.numpy()) / field.cell
    density = map_coordinates(field.values.numpy(), cells.reshape(-1, 3).T, order=1, mode="nearest")
    density = density.reshape(len(positions), STEPS)
    falls = (density[:, :-1] >= level) & (density[:, 1:] < level)
    share = (density[:, :-1] - level) / np.maximum(density[:, :-1] - density[:, 1:], 1e-9)
    crossings = np.where(falls, steps[:-1] + share * (steps[1] - steps[0]), np.inf)
    nearest = np.abs(crossings).argmin(1)
    distances = crossings[np.arange(len(positions)), nearest]
    return np.where(np.isfinite(distances), distances, 0.0)
