"""Gaussians on the surface of a model."""

import math

import numpy as np
import torch
import trimesh

from dg4d_lib.mesh.models.model import Model, ModelPart
from dg4d_lib.mesh.models.surface_cloud import cover_surface

QUARTER = torch.tensor([math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0])  # about y: z goes to x


def box() -> Model:
    """Return a box of 1 x 2 x 3."""
    mesh = trimesh.creation.box((1, 2, 3))
    return Model((ModelPart("box", mesh.vertices.astype(np.float32), np.asarray(mesh.faces)),))


def test_a_placed_surface_is_scaled_turned_and_moved_in_this_order() -> None:
    shift = torch.tensor([10.0, 0.0, 0.0])
    placed = cover_surface(box(), 200, torch.Generator().manual_seed(0)).placed(QUARTER, 2.0, shift)
    sides = [[8.5 - 1.5, -2, -1], [11.5 + 1.5, 2, 1]]  # x holds what z did, twice as long
    np.testing.assert_allclose([placed.fine.vertices.min(0), placed.fine.vertices.max(0)], sides, atol=1e-6)


def test_gaussians_stay_at_their_vertices_when_the_surface_is_placed() -> None:
    surface = cover_surface(box(), 200, torch.Generator().manual_seed(0))
    placed = surface.placed(QUARTER, 2.0, torch.tensor([10.0, 0.0, 0.0]))

    def distances(one) -> torch.Tensor:
        return (one.cloud.means - torch.from_numpy(one.fine.vertices[one.nearest]).float()).norm(dim=-1)

    torch.testing.assert_close(distances(placed), 2 * distances(surface), atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(placed.cloud.scales, 2 * surface.cloud.scales)
