"""Normals of triangle meshes."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize


def vertex_normals(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]) -> Float[Tensor, "v 3"]:
    """Return unit vertex normals, weighted by the areas of the adjacent faces; 0 for vertices without a face.

    Args:
        vertices: any units.
        faces: counter-clockwise seen from where the normals point to.
    """
    corners = vertices[faces.long()]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = torch.zeros_like(vertices).index_add_(0, faces.long().flatten(), area.repeat_interleave(3, 0))
    return normalize(total, dim=-1)
