"""The colors of Gaussians, projected back onto a surface (METHOD section 8; Tang et al. 2024, section 3.2).

Every texel looks at pictures of the Gaussians from 26 sides and from the input view, and keeps a mean of the colors it sees,
heavily in favor of the view that looks straight at it. Pictures are un-premultiplied and their soft outlines left out, so
nothing of a background gets into the texture.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numba import njit
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import max_pool2d, normalize

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.cameras.viewpoints import baking_views
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.render import sample
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.settings import MeshSettings

SHARPNESS = 4  # power of the cosine in a view's weight; 1 blurs, a large one leaves visible borders between views
INPUT_WEIGHT = 8.0  # of the input view against another one: only there the colors come from a picture
SOLID = 0.5  # alpha below which a pixel is background
OUTLINE = 2  # pixels: the band along outlines and along nearer surfaces that is not trusted
LAST_RESORT = 1e-4  # weight of views that are too flat or on an outline: they count where nothing better is
FLATTEST = 0.05  # cosine below which a view does not count at all
DEPTH_SLACK = 3.0  # pixel footprints by which a texel may lie behind the z-buffer, over the cosine
NEIGHBORS = 4  # seen texels whose colors an unseen one takes
VIEWS_AT_ONCE = 9


@dataclass(frozen=True)
class Texels:
    """The texels whose centers lie on the surface.

    Attributes:
        rows: in the texture.
        columns: in the texture.
        positions: world units.
        normals: of length 1, outwards.
    """

    rows: Int[Tensor, " p"]
    columns: Int[Tensor, " p"]
    positions: Float[Tensor, "p 3"]
    normals: Float[Tensor, "p 3"]


def bake(
    vertices: Float[Tensor, "v 3"],
    normals: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    uvs: Float[Tensor, "v 2"],
    gaussians: Gaussians,
    rasterize: Rasterizer,
    settings: MeshSettings,
) -> Float[Tensor, "h w 3"]:
    """The texture of a mesh that was made of these Gaussians.

    Args:
        vertices: world units, split at the seams.
        normals: of the surface before it was split (`vertex_normals`), one per split vertex.
        faces: counter-clockwise seen from outside.
        uvs: in [0, 1], v down.
        gaussians: one state.
        rasterize: the splatting backend.
        settings: of the mesh.

    Returns:
        Colors in [0, 1] of every texel; texels outside of all charts repeat the nearest one inside.
    """
    texels = texels_of(vertices, normals, faces, uvs, settings.texture_size)
    size = settings.texture_size
    if len(texels.rows) == 0:  # all triangles are smaller than a texel
        return torch.full((size, size, 3), 0.5)
    total = torch.zeros(len(texels.rows), 3)
    weight = torch.zeros(len(texels.rows), 1)
    cameras = [OrbitCamera(width=settings.render_size, height=settings.render_size), *baking_views(settings.render_size)]
    boosts = [INPUT_WEIGHT] + [1.0] * (len(cameras) - 1)
    for start in range(0, len(cameras), VIEWS_AT_ONCE):
        batch = cameras[start : start + VIEWS_AT_ONCE]
        for view, boost in zip(_views(batch, vertices, faces, gaussians, rasterize), boosts[start:], strict=False):
            color, trust = _look(view, texels, settings.min_cosine)
            total += boost * trust * color
            weight += boost * trust
    seen = weight[:, 0] > 0
    colors = torch.where(seen[:, None], total / weight.clamp_min(1e-30), torch.full_like(total, 0.5))
    colors = _spread(colors, seen, texels.positions)
    return _padded(colors, texels, size)


def vertex_normals(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"]) -> Float[Tensor, "v 3"]:
    """Outward normals of length 1, weighted by the areas of the faces around a vertex."""
    corners = vertices[faces.long()]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = torch.zeros_like(vertices).index_add_(0, faces.long().flatten(), area.repeat_interleave(3, 0))
    return normalize(total, dim=-1)


def texels_of(
    vertices: Float[Tensor, "v 3"],
    normals: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    uvs: Float[Tensor, "v 2"],
    size: int,
) -> Texels:
    """Where the texels of a square texture lie on the surface; a texel's center is at (index + 0.5) / size."""
    ids, weights = np.full((size, size), -1, np.int32), np.zeros((size, size, 3), np.float32)
    _map(uvs.double().numpy() * size, faces.to(torch.int32).numpy(), ids, weights)
    rows, columns = np.nonzero(ids >= 0)
    corners = faces.long()[torch.from_numpy(ids[rows, columns].astype(np.int64))]
    share = torch.from_numpy(weights[rows, columns])[..., None]
    return Texels(
        torch.from_numpy(rows),
        torch.from_numpy(columns),
        (share * vertices[corners]).sum(1),
        normalize((share * normals[corners]).sum(1), dim=-1),
    )


@dataclass(frozen=True)
class _View:
    """What one camera shows: straight color, where it is to be trusted, and how far the mesh is."""

    camera: OrbitCamera
    color: Float[Tensor, "h w 3"]
    solid: Bool[Tensor, "h w"]
    inner: Bool[Tensor, "h w"]
    depth: Float[Tensor, "h w"]
    front: Float[Tensor, "h w"]


def _views(
    cameras: Sequence[OrbitCamera],
    vertices: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    gaussians: Gaussians,
    rasterize: Rasterizer,
) -> list[_View]:
    with torch.no_grad():
        picture = rasterize(gaussians, cameras, torch.zeros(3))
    straight = (picture.color / picture.alpha.clamp_min(1e-6)).clamp(0, 1)
    alpha = picture.alpha[..., 0]
    depth = rasterize_mesh(vertices, faces, cameras).depth
    depth = torch.where(depth > 0, depth, torch.full_like(depth, torch.inf))
    inner, front = _lowest(alpha) > SOLID, _lowest(depth)
    parts = zip(cameras, straight, alpha > SOLID, inner, depth, front, strict=True)
    return [_View(*part) for part in parts]


def _lowest(values: Float[Tensor, "b h w"]) -> Float[Tensor, "b h w"]:
    """The least value within `OUTLINE` pixels."""
    return -max_pool2d(-values, 2 * OUTLINE + 1, stride=1, padding=OUTLINE)


def _look(view: _View, texels: Texels, min_cosine: float) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p 1"]]:
    """What the texels see in one picture, and how much that counts (0: nothing)."""
    camera = view.camera
    pose = camera.world_to_camera().float()
    local = texels.positions @ pose[:3, :3].T + pose[:3, 3]
    cosine = ((camera.position().float() - texels.positions) * texels.normals).sum(-1) / local.norm(dim=-1)
    pixels = local[:, :2] / local[:, 2:] * camera.focal + torch.tensor([camera.width / 2, camera.height / 2])
    column, row = pixels.floor().long().unbind(-1)
    kept = (cosine > FLATTEST) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    row, column = row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)
    behind = local[:, 2] - DEPTH_SLACK * local[:, 2] / camera.focal / cosine.clamp_min(FLATTEST)
    kept &= (behind <= view.depth[row, column]) & view.solid[row, column]
    good = (cosine > min_cosine) & view.inner[row, column] & (behind <= view.front[row, column])
    trust = torch.where(good, 1.0, LAST_RESORT) * cosine.clamp_min(0) ** SHARPNESS * kept
    color = torch.zeros_like(texels.positions)
    size = torch.tensor([camera.width, camera.height])
    color[kept] = sample(view.color, pixels[kept] / size)
    return color, trust[:, None]


def _spread(
    colors: Float[Tensor, "p 3"], seen: Bool[Tensor, " p"], positions: Float[Tensor, "p 3"]
) -> Float[Tensor, "p 3"]:
    """Texels that no view saw take the colors of the nearest ones on the surface that were seen."""
    if bool(seen.all()) or not bool(seen.any()):
        return colors
    count = min(NEIGHBORS, int(seen.sum()))
    distance, nearest = cKDTree(positions[seen].numpy()).query(positions[~seen].numpy(), k=range(1, count + 1))
    share = 1 / (torch.from_numpy(distance).float() + 1e-6)
    taken = colors[seen][torch.from_numpy(nearest)]
    colors = colors.clone()
    colors[~seen] = (share[..., None] * taken).sum(1) / share.sum(1, keepdim=True)
    return colors


def _padded(colors: Float[Tensor, "p 3"], texels: Texels, size: int) -> Float[Tensor, "h w 3"]:
    """The texture, every empty texel a copy of the nearest full one."""
    texture, empty = np.zeros((size, size, 3), np.float32), np.ones((size, size), bool)
    texture[texels.rows, texels.columns] = colors.numpy()
    empty[texels.rows, texels.columns] = False
    rows, columns = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
    return torch.from_numpy(texture[rows, columns])


@njit(cache=True, nogil=True)
def _map(corners, faces, ids, weights):  # type: ignore[no-untyped-def]
    """Which triangle lies over which texel's center, and the weights of its corners; all lengths in texels."""
    height, width = ids.shape
    for f in range(faces.shape[0]):
        xa, ya = corners[faces[f, 0], 0] - 0.5, corners[faces[f, 0], 1] - 0.5
        xb, yb = corners[faces[f, 1], 0] - 0.5, corners[faces[f, 1], 1] - 0.5
        xc, yc = corners[faces[f, 2], 0] - 0.5, corners[faces[f, 2], 1] - 0.5
        area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
        if area == 0:
            continue
        for row in range(max(0, int(np.ceil(min(ya, yb, yc)))), min(height - 1, int(np.floor(max(ya, yb, yc)))) + 1):
            for column in range(
                max(0, int(np.ceil(min(xa, xb, xc)))), min(width - 1, int(np.floor(max(xa, xb, xc)))) + 1
            ):
                a = ((xb - column) * (yc - row) - (xc - column) * (yb - row)) / area
                b = ((xc - column) * (ya - row) - (xa - column) * (yc - row)) / area
                c = 1 - a - b
                if a >= 0 and b >= 0 and c >= 0:
                    ids[row, column] = f
                    weights[row, column, 0], weights[row, column, 1], weights[row, column, 2] = a, b, c
