"""Closed surface of a predicted shape, colored by the picture and the hidden colors."""

import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage
from skimage.measure import marching_cubes
from torch import Tensor
from torch.nn.functional import cosine_similarity, grid_sample

from dg4d_lib.cameras.orbit import RADIUS
from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.shape_prior.decided import most_probable, smooth_logits
from dg4d_lib.shape_prior.field import ShapeField
from dg4d_lib.shape_prior.frustum import BINS, FAR, NEAR, SIZE, TAN_HALF_FOV

BEHIND = 2.5  # cells behind the first surface of a ray from which a point is hidden
FACING = 12.0  # slope from hidden to seen over the cosine between normal and camera


def decided_surface(field: ShapeField) -> InflatedSurface:
    """Extract the surface around the most probable cells of every ray, somewhat more than matter is expected on it.

    A surface at one probability would leave out what is sure to be there but not where, or be far too thick.
    """
    chosen = most_probable(
        smooth_logits(field.logits, field.mask, field.smoothness), field.mask, field.generosity
    ).numpy()
    volume = np.pad(chosen, 1, constant_values=-1.0)
    places, faces, _, _ = marching_cubes(volume, 0.0)
    row, column, cell = (places - 0.5).astype(np.float64).T
    distance = NEAR + cell / BINS * (FAR - NEAR)
    x, y = (2 * column / SIZE - 1) * TAN_HALF_FOV, (1 - 2 * row / SIZE) * TAN_HALF_FOV
    vertices = torch.from_numpy(np.stack([x * distance, y * distance, RADIUS - distance], -1))
    triangles = _outward(vertices, torch.from_numpy(faces.astype(np.int64)))
    first = torch.from_numpy(np.argmax(chosen > 0, -1)).float()
    shown = _shown(vertices, triangles, torch.from_numpy(np.stack([row, column, cell], -1)), first)
    at = torch.from_numpy(np.stack([2 * column / SIZE - 1, 2 * row / SIZE - 1], -1)).float()
    place = torch.cat([torch.from_numpy(2 * cell / BINS - 1)[:, None].float(), at], 1)[None, None, None]
    hidden = grid_sample(field.hidden.permute(3, 0, 1, 2)[None], place, align_corners=False, padding_mode="border")
    own = grid_sample(_extended(field), at[None, None], align_corners=False, padding_mode="border")[0, :, 0].T
    colors = shown[:, None] * own + (1 - shown)[:, None] * hidden[0, :, 0, 0].T
    return InflatedSurface(vertices.float(), triangles, colors.clamp(0, 1).float(), shown > 0.5)


def _outward(vertices: Float[Tensor, "v 3"], triangles: Tensor) -> Tensor:
    corners = vertices[triangles]
    volume = (corners[:, 0] * torch.linalg.cross(corners[:, 1], corners[:, 2])).sum()
    return triangles if volume > 0 else triangles.flip(1)


def _shown(
    vertices: Float[Tensor, "v 3"], triangles: Tensor, cells: Float[Tensor, "v 3"], first: Float[Tensor, "128 128"]
) -> Float[Tensor, " v"]:
    """Return 1 for vertices that face the input camera with nothing before them, 0 for hidden ones."""
    corners = vertices[triangles]
    crosses = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = torch.zeros_like(vertices)
    for corner in range(3):
        normals.index_add_(0, triangles[:, corner], crosses)
    to_camera = torch.tensor([0.0, 0, RADIUS], dtype=vertices.dtype) - vertices
    row, column = (part.long().clamp(0, SIZE - 1) for part in (cells[:, 0], cells[:, 1]))
    near = cells[:, 2] < first[row, column] + BEHIND
    return (torch.sigmoid(FACING * cosine_similarity(normals, to_camera)) * near).float()


def _extended(field: ShapeField) -> Float[Tensor, "1 3 128 128"]:
    """Return the picture, its colors carried on beyond the outline."""
    inside = ndimage.binary_erosion(field.mask.numpy())
    inside = inside if inside.any() else field.mask.numpy()
    rows, columns = ndimage.distance_transform_edt(~inside, return_distances=False, return_indices=True)
    return field.front[rows, columns].permute(2, 0, 1)[None]
