"""Chamfer distance of surfaces, by point samples."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from dg4d_lib.errors import BadInput


def chamfer_distance(a: Float[Tensor, "n 3"], b: Float[Tensor, "m 3"]) -> float:
    """Return the mean distance from points of either cloud to the nearest of the other, averaged over both directions.

    Points are not the surfaces they are sampled from: two samples of one surface are about half a spacing apart,
    0.5 sqrt(area / samples).
    """
    there, _ = cKDTree(b.numpy()).query(a.numpy())
    back, _ = cKDTree(a.numpy()).query(b.numpy())
    return float(np.mean(there) + np.mean(back)) / 2


def align_bounding_boxes(points: Float[Tensor, "t n 3"], target: Float[Tensor, "t m 3"]) -> Float[Tensor, "t n 3"]:
    """Align moving points by one translation and one uniform scale for all frames, which match their bounding boxes.

    A box holds 96 % of the points along every axis; it leaves out the 2 % at either end.
    """
    (center, size), (target_center, target_size) = (_box(cloud.flatten(0, 1)) for cloud in (points, target))
    return (points - center) * (target_size / size.clamp_min(torch.finfo(size.dtype).tiny)) + target_center


@dataclass(frozen=True)
class SurfacePoints:
    """Points that keep their places on a surface while it moves.

    Attributes:
        corners: vertices of the triangle of each point.
        u: share of the second corner.
        v: share of the third corner.
    """

    corners: Int[Tensor, "n 3"]
    u: Float[Tensor, " n"]
    v: Float[Tensor, " n"]

    def at(self, vertices: Float[Tensor, "v 3"]) -> Float[Tensor, "n 3"]:
        """Return their positions, in double precision."""
        places = vertices.detach().cpu().double()[self.corners]
        first, second = places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]
        return places[:, 0] + self.u[:, None] * first + self.v[:, None] * second


def sample_surface(
    vertices: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    samples: int,
    generator: torch.Generator,
    weights: Float[Tensor, " f"] | None = None,
) -> Float[Tensor, "samples 3"]:
    """Sample points uniformly on a surface, in double precision on the CPU.

    Args:
        vertices: of the surface.
        faces: triangles.
        samples: number of points.
        generator: draws them; a CPU generator.
        weights: factors on the areas of the triangles, for example 0 for hidden ones; None is 1.

    Raises:
        BadInput: the triangles have no area.
    """
    return place_points(vertices, faces, samples, generator, weights).at(vertices)


def place_points(
    vertices: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    samples: int,
    generator: torch.Generator,
    weights: Float[Tensor, " f"] | None = None,
) -> SurfacePoints:
    """Choose the places that `sample_surface` samples, with its arguments."""
    corners = vertices.detach().cpu().double()[faces.cpu().long()]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    areas = torch.linalg.cross(first, second).norm(dim=-1)
    ends = (areas if weights is None else areas * weights.cpu().double()).cumsum(0)
    if len(faces) == 0 or not 0 < float(ends[-1]) < torch.inf:
        raise BadInput(f"a surface of {len(faces)} triangles has no area and cannot be sampled")
    position, u, v = torch.rand(3, samples, generator=generator, dtype=torch.float64)
    selected = torch.searchsorted(ends, position * ends[-1], right=True).clamp(max=len(faces) - 1)
    outside = u + v > 1  # the other half of the parallelogram, mirrored back
    u, v = torch.where(outside, 1 - u, u), torch.where(outside, 1 - v, v)
    return SurfacePoints(faces.cpu().long()[selected], u, v)


def _box(points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, " 3"], Float[Tensor, ""]]:
    """Return center and diagonal of the box of most points."""
    low, high = (torch.from_numpy(np.percentile(points.numpy(), share, axis=0)) for share in (2, 98))
    return (low + high) / 2, (high - low).norm()
