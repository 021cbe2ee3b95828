"""Gaussians on the surface of a model, bound to its subdivided triangles."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.transform import transform
from dg4d_lib.geometry.quaternion import quat_to_rotmat
from dg4d_lib.geometry.spherical_harmonics import rgb_to_sh
from dg4d_lib.mesh.extraction.topology import group_vertices
from dg4d_lib.mesh.models.model import OPAQUE, TRANSPARENT, Model
from dg4d_lib.mesh.models.subdivision import FineMesh, subdivide

WELD = 1e-5  # vertices closer than this are merged, share of the model's size
EDGE = 0.03  # longest edge of the subdivided surface, share of the model's size
MAX_VERTICES = 20000  # of the subdivided surface
OPACITY = 0.95  # at the center of a Gaussian
SPREAD = 0.45  # standard deviation, times the root of the area per Gaussian: outlines neither grow nor get holes
FLATNESS = 0.15  # standard deviation along the normal, times that in the surface


@dataclass(frozen=True)
class SurfaceCloud:
    """A model's surface as Gaussians.

    Attributes:
        fine: welded and subdivided surface.
        welded: vertex of `fine` for every vertex of the model.
        cloud: Gaussians at rest, flat on the surface.
        nearest: vertex of `fine` that every Gaussian is next to, in its triangle.
    """

    fine: FineMesh
    welded: Int[np.ndarray, " v"]
    cloud: Gaussians
    nearest: Int[Tensor, " n"]

    def placed(self, quat: Float[Tensor, " 4"], scale: float, shift: Float[Tensor, " 3"]) -> "SurfaceCloud":
        """Return the surface after scaling, rotation by a unit quaternion (wxyz), and translation."""
        matrix = scale * quat_to_rotmat(quat.double()).numpy()
        vertices = self.fine.vertices @ matrix.T + shift.double().numpy()
        return replace(
            self, fine=replace(self.fine, vertices=vertices), cloud=transform(self.cloud, quat, scale, shift)
        )


def cover_surface(model: Model, count: int, generator: torch.Generator) -> SurfaceCloud:
    """Cover a model with `count` Gaussians, evenly over its area.

    Args:
        model: in world units.
        count: number of Gaussians; fewer where masked materials have holes.
        generator: draws their places.

    Raises:
        BadInput: the triangles have no area, or all of it is transparent.
    """
    vertices, faces = model.vertices.astype(np.float64), model.faces
    size = float(np.linalg.norm(vertices.max(0) - vertices.min(0)))
    first, welded = group_vertices(vertices, max(WELD * size, 1e-12))
    fine = subdivide(vertices[first], welded[faces], EDGE * size, MAX_VERTICES)
    corners = fine.vertices[fine.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    ends = np.cumsum(areas)
    if not size or not 0 < ends[-1] < math.inf:
        raise BadInput("the triangles of the model have no area; export it again")
    along, u, v = torch.rand(3, count, generator=generator, dtype=torch.float64).numpy()
    selected = np.searchsorted(ends, (np.arange(count) + along) / count * ends[-1], side="right").clip(
        max=len(ends) - 1
    )
    root = np.sqrt(u)
    weights = np.stack([1 - root, root * (1 - v), root * v], 1)
    places = np.einsum("nk,nkc->nc", weights, fine.barycentrics[selected])
    colors, alpha = model.sample(fine.sources[selected], places)
    kept = alpha >= OPAQUE
    if not kept.any():
        raise BadInput(TRANSPARENT)
    selected, weights, colors = selected[kept], weights[kept], colors[kept]
    means = np.einsum("nk,nkc->nc", weights, corners[selected])
    scale = SPREAD * math.sqrt(0.5 * ends[-1] / count)
    log_scales = torch.tensor([scale, scale, FLATNESS * scale]).log().expand(len(means), 3).clone()
    cloud = Gaussians(
        torch.from_numpy(means.astype(np.float32)),
        log_scales,
        _facing(torch.from_numpy(normals[selected] / areas[selected, None])),
        torch.full((len(means),), math.log(OPACITY / (1 - OPACITY))),
        rgb_to_sh(torch.from_numpy(colors)),
    )
    nearest = np.take_along_axis(fine.faces[selected], weights.argmax(1)[:, None], 1)[:, 0]
    return SurfaceCloud(fine, welded, cloud, torch.from_numpy(nearest))


def _facing(normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """Return rotations that turn the z axis to unit normals."""
    w = 1 + normals[:, 2]
    quats = torch.stack([w, -normals[:, 1], normals[:, 0], torch.zeros_like(w)], 1)
    flipped = quats.new_tensor((0.0, 1.0, 0.0, 0.0))  # the opposite direction, where the formula is 0
    quats = torch.where((w > 1e-6)[:, None], quats, flipped)
    return torch.nn.functional.normalize(quats, dim=-1).float()
