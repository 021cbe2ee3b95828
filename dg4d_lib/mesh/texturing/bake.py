"""Texture baking: colors of pictures and Gaussians projected onto a mesh (Tang et al. 2024, section 3.2).

The Gaussians, or another guess of the subject, are rendered from 26 views and from the input view; every texel takes a
weighted mean of the colors it projects to; views that face it head-on weigh most. Frames of the driving video replace
the input view where there are some. Colors are un-premultiplied and pixels along soft silhouettes skipped, so no
background bleeds into the texture.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, no_type_check

import numpy as np
import OpenImageIO as oiio
import torch
from jaxtyping import Bool, Float, Int, UInt8
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize, pad

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.cameras.viewpoints import baking_views
from dg4d_lib.errors import DG4DError
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.kernels.compiling import njit
from dg4d_lib.kernels.workers import run_parallel
from dg4d_lib.mesh.extraction.silhouettes import ALPHA_THRESHOLD
from dg4d_lib.mesh.shifts import shifted
from dg4d_lib.mesh.texturing.seams import level_seams, seam_points
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh
from dg4d_lib.rasterizer.interface import Rasterizer
from dg4d_lib.settings import MeshSettings

SHARPNESS = 2  # exponent of a view's weight in cosine above the minimum and reliable share; views blend without seams
INPUT_WEIGHT = 200.0  # weight of the input view relative to others; only its colors come from a photograph
MIN_COSINE = 0.5  # texels seen at a more oblique angle are not colored
INPUT_MIN_COSINE = 0.6 * MIN_COSINE  # the same in the input view: a stretched true color is better than a predicted one
INSIDE = 2  # grade of a pixel inside a silhouette; 1 along it, 0 outside
OUTLINE = 2  # width of the unreliable band along silhouettes and occluding edges, pixels
LAST_RESORT = 1e-4  # weight of oblique views and of the unreliable band, used only where no better view exists
FLATTEST = 0.05  # cosine below which a view is ignored
DEPTH_SLACK = 1.5  # tolerance of the depth test, in pixels of a texel's projected position
NEIGHBORS = 4  # colored texels that a texel without a view interpolates
GUTTER = 2  # texels of chart border that are repeated outwards, for bilinear filtering and the next mip level
GUTTER_SHIFTS = sorted(itertools.product(range(-GUTTER, GUTTER + 1), repeat=2), key=lambda shift: math.hypot(*shift))
VIEWS_AT_ONCE = 9  # bounds memory
TEXELS_AT_ONCE = 1 << 16  # texels per job of the thread pool


Pictures = tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 1"]]  # straight color and alpha, in [0, 1]
Draw = Callable[[Sequence[OrbitCamera]], Pictures]
GradedPictures = tuple[
    Float[Tensor, "b h w 3"], UInt8[Tensor, "b h w"], Float[Tensor, "b h w"], Float[Tensor, "b h w"]
]  # color, grade, depth, and the least depth nearby: see `grade_pixels`


@dataclass(frozen=True)
class PosedSurface:
    """Surface at one frame of the driving video, and its picture from the input view.

    Attributes:
        vertices: world units, split along the seams.
        normals: of the unsplit surface, one per split vertex.
        color: straight color of the frame, in [0, 1].
        alpha: of the frame, in [0, 1].
        weight: of its colors, relative to other frames.
    """

    vertices: Float[Tensor, "v 3"]
    normals: Float[Tensor, "v 3"]
    color: Float[Tensor, "h w 3"]
    alpha: Float[Tensor, "h w 1"]
    weight: float = 1.0


class CoveredTexels(NamedTuple):
    """Texels in charts; their centers are at (index + 0.5) / size.

    Attributes:
        rows: row in the texture.
        columns: column in the texture.
        corners: of their triangles, indices of vertices.
        shares: barycentric weights of the corners.
    """

    rows: Int[Tensor, " p"]
    columns: Int[Tensor, " p"]
    corners: Int[Tensor, "p 3"]
    shares: Float[Tensor, "p 3"]


@dataclass(frozen=True)
class Texels:
    """Texels whose centers lie on the surface.

    Attributes:
        rows: row in the texture.
        columns: column in the texture.
        positions: on the surface, world units.
        normals: unit normals, outwards.
    """

    rows: Int[Tensor, " p"]
    columns: Int[Tensor, " p"]
    positions: Float[Tensor, "p 3"]
    normals: Float[Tensor, "p 3"]


def bake_texture(
    vertices: Float[Tensor, "v 3"],
    normals: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    uvs: Float[Tensor, "v 2"],
    draw: Draw,
    settings: MeshSettings,
    footage: Sequence[PosedSurface] = (),
) -> Float[Tensor, "h w 3"]:
    """Bake the texture of a mesh from renders of the subject, and from the frames that the mesh follows.

    Args:
        vertices: world units, split along the seams.
        normals: of the unsplit surface (`dg4d_lib.geometry.normals.vertex_normals`), one per split vertex.
        faces: counter-clockwise seen from outside.
        uvs: texture coordinates in [0, 1], v down.
        draw: renders the Gaussians (`gaussian_renderer`), or another guess of the subject.
        settings: mesh settings.
        footage: the surface at frames of the driving video. They are averaged, and take the place of the renders in
            the input view.

    Returns:
        Colors in [0, 1] of every texel; texels outside all charts are filled from their surroundings, and both sides of
        a seam have the same colors.
    """
    size, side = settings.texture_size, settings.render_size
    covered = covered_texels(faces, uvs, size)
    texels = placed_texels(covered, vertices, normals)
    if len(texels.rows) == 0:  # all triangles are smaller than a texel
        return torch.full((size, size, 3), 0.5)
    total = np.zeros((len(texels.rows), 4), np.float32)  # sums of weight * color and of weight
    add_footage(footage, covered, faces, side, INPUT_WEIGHT, total)
    cameras = [OrbitCamera(width=side, height=side), *baking_views(side)]
    for start in range(0, len(cameras), VIEWS_AT_ONCE):
        batch = cameras[start : start + VIEWS_AT_ONCE]
        color, alpha = draw(batch)
        renders = grade_pixels(color, alpha[..., 0], batch, vertices, faces, OUTLINE)
        rules = [(MIN_COSINE, 1.0)] * len(batch)
        if start == 0 and not footage:
            rules[0] = INPUT_MIN_COSINE, INPUT_WEIGHT
        add_views(texels, batch, renders, rules, total)
    weight = torch.from_numpy(total[:, 3:])
    seen = weight[:, 0] > 0
    colors = torch.where(seen[:, None], torch.from_numpy(total[:, :3]) / weight.clamp_min(1e-30), 0.5)
    colors = _fill_unseen(colors, seen, texels.positions)
    return level_seams(fill_texture(colors, texels, size), seam_points(vertices, faces, uvs, size))


def locate_texels(
    vertices: Float[Tensor, "v 3"],
    normals: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    uvs: Float[Tensor, "v 2"],
    size: int,
) -> Texels:
    """Locate the texels of a square texture on the surface; texel centers are at (index + 0.5) / size."""
    return placed_texels(covered_texels(faces, uvs, size), vertices, normals)


def covered_texels(faces: Int[Tensor, "f 3"], uvs: Float[Tensor, "v 2"], size: int) -> CoveredTexels:
    """Return the texels in charts of a square texture."""
    ids, weights = np.full((size, size), -1, np.int32), np.zeros((size, size, 3), np.float32)
    _rasterize_uvs(uvs.double().numpy() * size, faces.to(torch.int32).numpy(), ids, weights)
    found = torch.from_numpy(ids)
    rows, columns = torch.nonzero(found >= 0, as_tuple=True)
    corners = faces.long()[found[rows, columns].long()]
    return CoveredTexels(rows, columns, corners, torch.from_numpy(weights)[rows, columns])


def placed_texels(covered: CoveredTexels, vertices: Float[Tensor, "v 3"], normals: Float[Tensor, "v 3"]) -> Texels:
    """Return the texels where the vertices are."""
    positions, facing = (_interpolated(values, covered.corners, covered.shares) for values in (vertices, normals))
    return Texels(covered.rows, covered.columns, positions, normalize(facing, dim=-1))


def _interpolated(
    values: Float[Tensor, "v 3"], corners: Int[Tensor, "p 3"], shares: Float[Tensor, "p 3"]
) -> Float[Tensor, "p 3"]:
    """Return values of vertices at places in triangles; one corner after the other takes half the time."""
    first, *others = (
        values.index_select(0, corner) * share[:, None]
        for corner, share in zip(corners.unbind(1), shares.unbind(1), strict=True)
    )
    return sum(others, first)


def add_footage(
    footage: Sequence[PosedSurface],
    covered: CoveredTexels,
    faces: Int[Tensor, "f 3"],
    side: float,
    weight: float,
    total: NDArray[np.float32],
) -> None:
    """Add the colors that frames of the driving video show to the sums of texels.

    Args:
        footage: the surface at these frames.
        covered: p texels.
        faces: of the surface.
        side: pixels of a side of pictures whose unreliable band is `OUTLINE` pixels wide; that of coarser frames is
            narrower, but not below a pixel.
        weight: of the frames.
        total: "p 4", sums of weight * color and of weight; changed.
    """
    for posed in footage:
        camera = OrbitCamera(width=posed.color.shape[1], height=posed.color.shape[0])
        moved = placed_texels(covered, posed.vertices, posed.normals)
        reach = max(1, round(OUTLINE * camera.width / side))
        pictures = grade_pixels(posed.color[None], posed.alpha[None, ..., 0], [camera], posed.vertices, faces, reach)
        add_views(moved, [camera], pictures, [(INPUT_MIN_COSINE, weight * posed.weight)], total)


def add_views(
    texels: Texels,
    cameras: Sequence[OrbitCamera],
    pictures: GradedPictures,
    rules: Sequence[tuple[float, float]],
    total: NDArray[np.float32],
) -> None:
    """Add the colors that texels project to in some views to their sums.

    Args:
        texels: p texels.
        cameras: of the views.
        pictures: of the views (`grade_pixels`).
        rules: minimum cosine and weight of every view.
        total: "p 4", sums of weight * color and of weight; changed.
    """
    parts = [slice(start, start + TEXELS_AT_ONCE) for start in range(0, len(total), TEXELS_AT_ONCE)]
    run_parallel([partial(_add, texels, cameras, pictures, rules, part, total) for part in parts])


def _add(
    texels: Texels,
    cameras: Sequence[OrbitCamera],
    renders: GradedPictures,
    rules: Sequence[tuple[float, float]],
    part: slice,
    total: NDArray[np.float32],
) -> None:
    """Add the colors of some texels to their sums."""
    positions, normals = texels.positions[part].numpy(), texels.normals[part].numpy()
    for view, (camera, rule) in enumerate(zip(cameras, rules, strict=True)):
        pose = camera.viewmat().numpy(), camera.position().numpy(), camera.focal
        images = (render[view].numpy() for render in renders)
        _gather(positions, normals, *pose, *images, *rule, total[part])


def gaussian_renderer(gaussians: Gaussians, rasterize: Rasterizer) -> Draw:
    """Return a function that renders one state of a cloud."""

    def draw(cameras: Sequence[OrbitCamera]) -> Pictures:
        with torch.no_grad():
            render = rasterize(gaussians, cameras, torch.zeros(3))
        return (render.color / render.alpha.clamp_min(1e-6)).clamp(0, 1), render.alpha

    return draw


def grade_pixels(
    color: Float[Tensor, "b h w 3"],
    alpha: Float[Tensor, "b h w"],
    cameras: Sequence[OrbitCamera],
    vertices: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    reach: int,
) -> GradedPictures:
    """Grade the pixels of pictures by their distance from the silhouette, and add the depth of the mesh.

    Args:
        color: straight, in [0, 1].
        alpha: in [0, 1].
        cameras: of the pictures.
        vertices: of the mesh, world units.
        faces: indices into the vertices.
        reach: width of the unreliable band along silhouettes and occluding edges, pixels.

    Returns:
        The color; grade (0: background, 1: along the silhouette, `INSIDE`); camera z of the mesh, infinite where there
        is none; and the minimum of z within `reach` pixels.
    """
    depth = rasterize_mesh(vertices, faces, cameras).depth
    depth = torch.where(depth > 0, depth, torch.full_like(depth, torch.inf))
    inside = _min_filter(alpha, reach) > ALPHA_THRESHOLD
    grade = (alpha > ALPHA_THRESHOLD).to(torch.uint8) + inside.to(torch.uint8)
    return color, grade, depth, _min_filter(depth, reach)


def _min_filter(values: Float[Tensor, "b h w"], reach: int) -> Float[Tensor, "b h w"]:
    """Return the minimum within some pixels."""
    for axis in (1, 2):
        border = [0, 0, reach, reach] if axis == 1 else [reach, reach]
        padded, length = pad(values, border, value=torch.inf), values.shape[axis]
        values = padded.narrow(axis, 0, length)
        for shift in range(1, 2 * reach + 1):
            values = torch.minimum(values, padded.narrow(axis, shift, length))
    return values


def _fill_unseen(
    colors: Float[Tensor, "p 3"], seen: Bool[Tensor, " p"], positions: Float[Tensor, "p 3"]
) -> Float[Tensor, "p 3"]:
    """Interpolate the colors of texels that no view saw from the nearest seen texels on the surface."""
    if bool(seen.all()) or not bool(seen.any()):
        return colors
    count = min(NEIGHBORS, int(seen.sum()))
    tree = cKDTree(positions[seen].numpy(), compact_nodes=False, balanced_tree=False)  # 45 times faster in cavities
    found = tree.query(positions[~seen].numpy(), k=range(1, count + 1))
    distance, nearest = (torch.from_numpy(np.asarray(a)) for a in found)
    weight, neighbors = 1 / (distance.float() + 1e-6), colors[seen][nearest]
    colors = colors.clone()
    colors[~seen] = (weight[..., None] * neighbors).sum(1) / weight.sum(1, keepdim=True)
    return colors


def fill_texture(colors: Float[Tensor, "p 3"], texels: Texels, size: int) -> Float[Tensor, "h w 3"]:
    """Write the texels into a texture and fill the empty ones.

    Empty texels within the gutter of a chart repeat the nearest texel of the chart, so that nothing bleeds over a seam.
    The others are filled by push-pull (Gortler et al. 1996, section 3.4), because smooth images compress well.
    """
    texture, covered = np.zeros((size, size, 4), np.float32), np.zeros((size, size), bool)
    texture[texels.rows, texels.columns] = np.pad(colors.numpy(), ((0, 0), (0, 1)), constant_values=1)
    covered[texels.rows, texels.columns] = True
    repeated = covered.copy()
    for shift in GUTTER_SHIFTS:  # the nearest first
        if math.hypot(*shift) > GUTTER:
            break
        onto, source = shifted(shift)
        fresh = covered[source] & ~repeated[onto]
        texture[onto][fresh] = texture[source][fresh]
        repeated[onto] |= fresh
    filled = oiio.ImageBufAlgo.fillholes_pushpull(oiio.ImageBuf(texture))
    if filled.has_error:
        raise DG4DError(f"OpenImageIO could not fill the texture: {filled.geterror()}; lower mesh.texture_size")
    pixels = np.asarray(filled.get_pixels(oiio.FLOAT))
    return torch.from_numpy((pixels[..., :3] / pixels[..., 3:]).clip(0, 1))


@njit(cache=True, nogil=True)
@no_type_check
def _rasterize_uvs(corners, faces, ids, weights):
    """Write the triangle over every texel center and the barycentric weights of its corners; lengths in texels."""
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


@njit(cache=True, nogil=True)
@no_type_check
def _gather(positions, normals, pose, eye, focal, color, grade, depth, front, min_cosine, boost, total):
    """Add the colors that the texels project to in one view to their sums; all arrays are of one view."""
    height, width = grade.shape
    for i in range(positions.shape[0]):
        x, y, z = positions[i, 0], positions[i, 1], positions[i, 2]
        tx, ty, tz = eye[0] - x, eye[1] - y, eye[2] - z
        cosine = tx * normals[i, 0] + ty * normals[i, 1] + tz * normals[i, 2]
        cosine /= np.sqrt(tx * tx + ty * ty + tz * tz)
        if not cosine > FLATTEST:
            continue
        far = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        if far <= 0:
            continue
        u = focal * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]) / far + 0.5 * width
        v = focal * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]) / far + 0.5 * height
        if not (0 <= u < width and 0 <= v < height):
            continue
        row, column = int(v), int(u)
        slope = far / focal / max(cosine, 0.2)  # upper bound of the depth change of a tilted surface within a pixel
        if grade[row, column] == 0 or far - DEPTH_SLACK * slope > depth[row, column]:
            continue
        left, top = min(max(u - 0.5, 0.0), width - 1.0), min(max(v - 0.5, 0.0), height - 1.0)
        c0, r0 = int(left), int(top)
        c1, r1 = min(c0 + 1, width - 1), min(r0 + 1, height - 1)
        a, b = left - c0, top - r0
        taps = (r0, c0, (1 - a) * (1 - b)), (r0, c1, a * (1 - b)), (r1, c0, (1 - a) * b), (r1, c1, a * b)
        reliable = 0.0  # share of the bilinear reading; that of the nearest pixel would be stairs in the texture
        for row, column, share in taps:
            beside = far - (DEPTH_SLACK + 1.5 * OUTLINE) * slope <= front[row, column]  # no occluding edge nearby
            if grade[row, column] == INSIDE and beside and far - DEPTH_SLACK * slope <= depth[row, column]:
                reliable += share
        facing = max((cosine - min_cosine) / (1 - min_cosine), 0.0)
        weight = boost * (facing * reliable) ** SHARPNESS + LAST_RESORT * cosine
        for row, column, share in taps:
            for k in range(3):
                total[i, k] += weight * share * color[row, column, k]
        total[i, 3] += weight
