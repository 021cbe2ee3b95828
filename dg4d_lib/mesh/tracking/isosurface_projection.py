"""Carried vertices put back onto the surface of their moment.

A vertex that rides its neighbors misses what they do besides moving rigidly: they grow, thin out, part. Along its
normal it goes to the nearest place where the density of that moment falls through the level, if there is one near.
"""

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from scipy.ndimage import map_coordinates
from torch import Tensor

from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.extraction.density import DensityField, density_field
from dg4d_lib.mesh.texturing.bake import vertex_normals
from dg4d_lib.settings import MeshSettings

DRAWN_IN = 1.4  # times the level of the surface: a mesh that joins what parts is too fat over the whole motion
REACH = 3.0  # cells of the density field: how far a vertex may go
STEPS = 13  # places that are looked at, from inside to outside
PASSES = 3  # the surface is looked for again from where the last pass came out
SMOOTHING = 3  # rounds in which a vertex's way takes half of its neighbors'


def project_to_isosurface(
    vertices: Float[Tensor, "v 3"],
    offsets: Float[Tensor, "t v 3"],
    faces: Int[Tensor, "f 3"],
    states: Gaussians,
    level: float,
    settings: MeshSettings,
) -> Float[Tensor, "t v 3"]:
    """The offsets, corrected along the normals of the moved mesh.

    Args:
        vertices: at rest, not split at seams.
        offsets: where they are carried at every frame.
        faces: counter-clockwise seen from outside.
        states: the cloud at every frame (fields "t n 3").
        level: density of the surface at rest; carried vertices go to 1.4 times that.
        settings: of the mesh.
    """
    mesh = trimesh.Trimesh(vertices.numpy(), faces.numpy(), process=False)
    mean_of_neighbors = trimesh.smoothing.laplacian_calculation(mesh)
    corrected = offsets.clone()
    for frame in range(len(offsets)):
        field = density_field(states.at(frame), settings)
        for _ in range(PASSES):
            moved = vertices + corrected[frame]
            normals = vertex_normals(moved, faces)
            ways = _ways(field, moved.numpy(), normals.numpy(), DRAWN_IN * level)
            for _ in range(SMOOTHING):
                ways = 0.5 * ways + 0.5 * (mean_of_neighbors @ ways)
            corrected[frame] += torch.from_numpy(ways.astype(np.float32))[:, None] * normals
    return corrected


def _ways(
    field: DensityField, places: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"], level: float
) -> Float[np.ndarray, " v"]:
    """How far along its normal every place has to go, world units; 0 where no surface is near."""
    steps = np.linspace(-REACH, REACH, STEPS) * field.cell
    samples = places[:, None] + steps[:, None] * normals[:, None]
    cells = (samples - field.origin.numpy()) / field.cell
    density = map_coordinates(field.values.numpy(), cells.reshape(-1, 3).T, order=1, mode="nearest")
    density = density.reshape(len(places), STEPS)
    falls = (density[:, :-1] >= level) & (density[:, 1:] < level)
    share = (density[:, :-1] - level) / np.maximum(density[:, :-1] - density[:, 1:], 1e-9)
    crossings = np.where(falls, steps[:-1] + share * (steps[1] - steps[0]), np.inf)
    nearest = np.abs(crossings).argmin(1)
    ways = crossings[np.arange(len(places)), nearest]
    return np.where(np.isfinite(ways), ways, 0.0)
