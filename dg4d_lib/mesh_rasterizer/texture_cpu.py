"""Places on a texture that pixels show, and their colors, as Numba kernels for CPUs; results are those of `texture`.

Each view is one job of the thread pool, so the number of threads does not change the result. Colors have no gradients.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, no_type_check

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.kernels.compiling import njit
from dg4d_lib.kernels.workers import run_parallel
from dg4d_lib.mesh_rasterizer.zbuffer import Fragments

_COMPILED = {"nogil": True, "cache": True, "error_model": "numpy"}


class Rasterized(NamedTuple):
    """Mesh with texture coordinates, and the fragments of its images.

    Attributes:
        vertices: one mesh for all images ("v 3") or one state per image ("b v 3"), world units.
        faces: indices into the vertices.
        uvs: texture coordinates in [0, 1], u right and v down.
        cameras: of the images.
        fragments: output of the rasterizer.
    """

    vertices: Float[Tensor, "*b v 3"]
    faces: Int[Tensor, "f 3"]
    uvs: Float[Tensor, "v 2"]
    cameras: Sequence[OrbitCamera]
    fragments: Fragments


class MipLevels(NamedTuple):
    """Texture and all its halvings.

    Attributes:
        texels: colors of all levels, row by row, the finest first.
        shapes: first texel, height and width of each level.
    """

    texels: Float32[np.ndarray, "n 3"]
    shapes: Int[np.ndarray, "l 3"]


def texture_places(rasterized: Rasterized, size: Sequence[int]) -> tuple[Float32[Tensor, "p 2"], Float32[Tensor, " p"]]:
    """Return texture coordinates and mip levels of all covered pixels, for a texture of that height and width."""
    starts = np.concatenate([[0], (rasterized.fragments.faces >= 0).sum((1, 2)).numpy().cumsum()])
    places, levels = np.empty((starts[-1], 2), np.float32), np.empty(starts[-1], np.float32)

    def place(view: int, *scene: object) -> None:
        part = slice(*starts[view : view + 2])
        _place(*scene, places[part], levels[part])

    _of_views(place, rasterized, size)
    return torch.from_numpy(places), torch.from_numpy(levels)


def texture_colors(
    rasterized: Rasterized, mips: MipLevels, light: Float[Tensor, " v"] | None, side: int
) -> tuple[Float32[Tensor, "b h w 3"], Float32[Tensor, "b h w 1"]]:
    """Return straight color and alpha of pixels, each the mean of `side` x `side` samples.

    Args:
        rasterized: the mesh in images whose pixels are the samples.
        mips: of the texture, colors in [0, 1].
        light: factor of the colors at every vertex; lit colors end at 1. None: 1.
        side: samples per pixel along each axis.
    """
    count, height, width = rasterized.fragments.faces.shape
    color = np.zeros((count, height // side, width // side, 3), np.float32)
    alpha = np.zeros((*color.shape[:3], 1), np.float32)
    factors = None if light is None else light.detach().float().numpy()

    def shade(view: int, *scene: object) -> None:
        _shade(*scene, *mips, factors, side, color[view], alpha[view])

    _of_views(shade, rasterized, mips.shapes[0, 1:].tolist())
    return torch.from_numpy(color), torch.from_numpy(alpha)


def _of_views(work: Callable[..., None], rasterized: Rasterized, size: Sequence[int]) -> None:
    """Call a function for every image with its number and the arguments of the kernels."""
    vertices, faces, uvs, cameras, fragments = rasterized
    states, coordinates = vertices.detach().double().numpy(), uvs.detach().double().numpy()
    triangles = np.ascontiguousarray(faces.int().numpy())
    ids, weights = fragments.faces.numpy(), fragments.barycentrics.detach().numpy()

    def of_view(view: int) -> None:
        pose, focal = cameras[view].viewmat().numpy(), cameras[view].focal
        seen = (states if states.ndim == 2 else states[view]) @ pose[:3, :3].T + pose[:3, 3]
        texels = float(size[1]), float(size[0])
        work(view, seen, triangles, coordinates, texels, focal, ids[view], weights[view])

    run_parallel([partial(of_view, view) for view in range(len(cameras))])


def mip_levels(texture: Float[Tensor, "y x 3"]) -> MipLevels:
    """Return a texture and all its halvings, down to a single texel."""
    levels = [texture.detach().float().numpy()]
    while max(levels[-1].shape[:2]) > 1:
        height, width = levels[-1].shape[:2]
        if height % 2 == width % 2 == 0:
            half = np.empty((height // 2, width // 2, 3), np.float32)
            _halve(levels[-1], half)
        else:
            square = torch.from_numpy(levels[-1]).movedim(-1, 0)
            half = adaptive_avg_pool2d(square, (-(-height // 2), -(-width // 2))).movedim(0, -1).contiguous().numpy()
        levels.append(half)
    sizes = np.array([level.shape[:2] for level in levels])
    firsts = np.concatenate([[0], sizes.prod(1).cumsum()[:-1]])
    texels = np.concatenate([level.reshape(-1, 3) for level in levels])
    return MipLevels(texels, np.concatenate([firsts[:, None], sizes], 1))


@njit(**_COMPILED)
@no_type_check
def _halve(texture, half):
    for row in range(half.shape[0]):
        for column in range(half.shape[1]):
            for k in range(3):
                upper = texture[2 * row, 2 * column, k] + texture[2 * row, 2 * column + 1, k]
                lower = texture[2 * row + 1, 2 * column, k] + texture[2 * row + 1, 2 * column + 1, k]
                half[row, column, k] = np.float32(0.25) * (upper + lower)


@njit(**_COMPILED)
@no_type_check
def _place(vertices, faces, uvs, texels, focal, ids, weights, places, levels):
    """Write texture coordinates and mip level of every covered pixel, row by row."""
    height, width = ids.shape
    pixel = 0
    for row in range(height):
        y = (row + 0.5 - 0.5 * height) / focal
        for column in range(width):
            if ids[row, column] < 0:
                continue
            x = (column + 0.5 - 0.5 * width) / focal
            u, v, level = _place_at(vertices, faces, ids[row, column], uvs, texels, focal, weights, row, column, x, y)
            places[pixel, 0], places[pixel, 1], levels[pixel] = u, v, level
            pixel += 1


@njit(**_COMPILED)
@no_type_check
def _place_at(vertices, faces, face, uvs, texels, focal, weights, row, column, x, y):
    """Return texture coordinates and mip level at a pixel with the ray (x, y, 1); see `texture` for the formulas."""
    u = v = 0.0
    for k in range(3):
        corner, weight = faces[face, k], np.float64(weights[row, column, k])
        u += weight * uvs[corner, 0]
        v += weight * uvs[corner, 1]
    total = u_right = v_right = u_down = v_down = 0.0
    for k in range(3):
        a, b, c = faces[face, k], faces[face, (k + 1) % 3], faces[face, (k + 2) % 3]
        bx, by, bz = vertices[b, 0], vertices[b, 1], vertices[b, 2]
        cx, cy, cz = vertices[c, 0], vertices[c, 1], vertices[c, 2]
        right, down = by * cz - bz * cy, bz * cx - bx * cz
        total += right * x + down * y + bx * cy - by * cx
        u_right += right * (uvs[a, 0] - u)
        v_right += right * (uvs[a, 1] - v)
        u_down += down * (uvs[a, 0] - u)
        v_down += down * (uvs[a, 1] - v)
    along_u, along_v = u_right * u_right + u_down * u_down, v_right * v_right + v_down * v_down
    square = (along_u * texels[0] ** 2 + along_v * texels[1] ** 2) / (focal * total) ** 2
    return u, v, 0.5 * np.log2(square / 6)


@njit(**_COMPILED)
@no_type_check
def _shade(vertices, faces, uvs, texels, focal, ids, weights, mips, sizes, light, side, color, alpha):
    """Add up color and coverage of the samples of every pixel, and divide them."""
    height, width = ids.shape
    coarsest = len(sizes) - 1
    sample = np.empty(3, np.float32)
    for row in range(height):
        y = (row + 0.5 - 0.5 * height) / focal
        for column in range(width):
            if ids[row, column] < 0:
                continue
            x = (column + 0.5 - 0.5 * width) / focal
            face = ids[row, column]
            u, v, level = _place_at(vertices, faces, face, uvs, texels, focal, weights, row, column, x, y)
            level = 0.0 if np.isnan(level) else min(max(level, 0.0), coarsest)  # in edge-on triangles
            lower = int(level)
            sample[:] = 0
            _read(mips, sizes, lower, u, v, np.float32(1 - (level - lower)), sample)
            if level > lower:
                _read(mips, sizes, lower + 1, u, v, np.float32(level - lower), sample)
            if light is not None:
                factor = np.float32(0)
                for k in range(3):
                    factor += weights[row, column, k] * light[faces[face, k]]
                for k in range(3):
                    sample[k] = min(sample[k] * factor, np.float32(1))
            for k in range(3):
                color[row // side, column // side, k] += sample[k]
            alpha[row // side, column // side, 0] += 1
    for row in range(color.shape[0]):
        for column in range(color.shape[1]):
            if alpha[row, column, 0] > 0:
                for k in range(3):
                    color[row, column, k] /= alpha[row, column, 0]
                alpha[row, column, 0] /= side * side


@njit(**_COMPILED)
@no_type_check
def _read(mips, sizes, level, u, v, weight, sample):
    """Add the color of one mip level, read bilinearly and clamped at the border."""
    first, height, width = sizes[level, 0], sizes[level, 1], sizes[level, 2]
    x, y = u * width - 0.5, v * height - 0.5
    x = min(x, width - 1.0) if x > 0 else 0.0  # also where it is not a number
    y = min(y, height - 1.0) if y > 0 else 0.0
    left, top = int(x), int(y)
    right, below = min(left + 1, width - 1), min(top + 1, height - 1)
    a, b = np.float32(x - left), np.float32(y - top)
    for k in range(3):
        upper = (1 - a) * mips[first + top * width + left, k] + a * mips[first + top * width + right, k]
        lower = (1 - a) * mips[first + below * width + left, k] + a * mips[first + below * width + right, k]
        sample[k] += weight * ((1 - b) * upper + b * lower)
