"""Closed surface of a volume, colored from the views that show it."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from dg4d_lib.geometry.normals import vertex_normals
from dg4d_lib.inflation.colors import front_colors
from dg4d_lib.inflation.mask import subject_mask
from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh
from dg4d_lib.visual_hull.carve import Volume
from dg4d_lib.visual_hull.known import KnownView

SHARPNESS = 4.0  # exponent of the cosine between normal and camera in the weight of a view
GRAZING = 0.15  # cosine below which a view does not color a point
SLACK = 2.5  # cells: depth by which a visible point may lie behind the first surface
NEAREST = 6  # colored vertices that color one that no view shows
FAINT = 1e-4  # weight below which a vertex counts as not shown


def extract(volume: Volume) -> tuple[Float[Tensor, "v 3"], Int[Tensor, "f 3"]]:
    """Return vertices (world units) and faces (counter-clockwise from outside) at level 0."""
    padded = np.pad(volume.values, 1, constant_values=-volume.step)
    places, faces, _, _ = marching_cubes(padded, 0.0)
    vertices = torch.from_numpy(volume.low + (places - 1) * np.float32(volume.step)).float()
    triangles = torch.from_numpy(faces.astype(np.int64))
    corners = vertices[triangles].double()
    inside = (corners[:, 0] * torch.linalg.cross(corners[:, 1], corners[:, 2])).sum() > 0
    return vertices, triangles if inside else triangles.flip(1)


def observations(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], views: Sequence[KnownView], cell: float
) -> tuple[Float[Tensor, "k v 3"], Float[Tensor, "k v"]]:
    """Return the color of every vertex in every view, and its weight: 0 where the view does not show it."""
    normals = vertex_normals(vertices, faces)
    pairs = [_observe(vertices, faces, normals, view, cell) for view in views]
    return torch.stack([color for color, _ in pairs]), torch.stack([weight for _, weight in pairs])


def _observe(
    vertices: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    normals: Float[Tensor, "v 3"],
    view: KnownView,
    cell: float,
) -> tuple[Float[Tensor, "v 3"], Float[Tensor, " v"]]:
    camera = view.camera
    matrix = camera.viewmat().float()
    seen = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    at = (seen[:, :2] / seen[:, 2:] * (2 * camera.focal / camera.height))[None, None]
    depth = rasterize_mesh(vertices, faces, [camera]).depth
    depth = torch.where(depth > 0, depth, 1e3)
    first = -torch.nn.functional.max_pool2d(-depth[None], 3, 1, 1)  # the nearest surface around a pixel hides the rest
    nearest = grid_sample(first, at, mode="nearest", align_corners=False)[0, 0, 0]
    straight = view.cutout.double().cpu().numpy()
    mask, alpha = subject_mask(straight[..., 3])
    colors = torch.from_numpy(front_colors(straight[..., :3], alpha, mask)).float().permute(2, 0, 1)[None]
    color = grid_sample(colors, at, align_corners=False, padding_mode="border")[0, :, 0].T
    cosine = (normals * normalize(camera.position().float() - vertices, dim=-1)).sum(-1)
    visible = (seen[:, 2] < nearest + SLACK * cell) & (cosine > GRAZING)
    return color, torch.where(visible, view.weight * (cosine - GRAZING).clamp(min=0) ** SHARPNESS, 0.0)


def blend(
    vertices: Float[Tensor, "v 3"], colors: Float[Tensor, "k v 3"], weights: Float[Tensor, "k v"]
) -> tuple[Float[Tensor, "v 3"], Float[Tensor, " v"]]:
    """Return the weighted mean color of every vertex, that of shown neighbors where no view shows it, and weights."""
    total = weights.sum(0)
    shown = total > FAINT
    blended = (weights[..., None] * colors).sum(0) / total.clamp(min=FAINT)[:, None]
    if shown.any() and not shown.all():
        count = min(NEAREST, int(shown.sum()))
        tree = cKDTree(vertices[shown].numpy(), compact_nodes=False, balanced_tree=False)  # faster far from points
        distances, indices = tree.query(vertices[~shown].numpy(), k=count)
        share = torch.from_numpy(1 / (np.asarray(distances).reshape(-1, count) + 1e-4)).float()
        near = blended[shown][torch.from_numpy(np.asarray(indices).reshape(-1, count))]
        blended[~shown] = (share[..., None] * near).sum(1) / share.sum(1, keepdim=True)
    return blended.clamp(0, 1), total


def colored_surface(volume: Volume, views: Sequence[KnownView]) -> InflatedSurface:
    """Extract the surface of a volume and color it from views."""
    vertices, faces = extract(volume)
    colors, weights = observations(vertices, faces, views, volume.step)
    blended, total = blend(vertices, colors, weights)
    return InflatedSurface(vertices, faces, blended, total > FAINT)
