"""Texture seams: the two places in a texture of every edge along which charts were cut, and their colors.

Both places of a point on a seam should have one color. Bilinear reading mixes texels inside and outside of a chart, so
texels along seams are corrected by least squares: small, smooth corrections for which the two readings agree.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.linalg import cg
from torch import Tensor

from dg4d_lib.mesh.extraction.topology import join_seams
from dg4d_lib.mesh.neighbors import half_edges, twin_half_edges

SAMPLES = 2  # points on a seam per texel of its length
REACH = 6  # texels around seams that are corrected
FIDELITY = 0.002  # weight of a correction itself, relative to that of a difference across a seam
SMOOTHNESS = 0.02  # weight of the difference of corrections of neighboring texels
ITERATIONS = 300  # of conjugate gradients

Array = NDArray[np.float64]


def seam_points(
    vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], uvs: Float[Tensor, "v 2"], size: int
) -> Float[np.ndarray, "s 2 2"]:
    """Return points on all seams: the two texture coordinates of each.

    Args:
        vertices: split along seams; copies lie at equal positions.
        faces: counter-clockwise seen from outside.
        uvs: texture coordinates in [0, 1], v down.
        size: side of the texture, texels.
    """
    _, joined = join_seams(vertices.detach().cpu().numpy(), faces.cpu().numpy())
    one, other = half_edges(faces.cpu().numpy())[twin_half_edges(half_edges(joined))].swapaxes(0, 1)  # edge, end
    cut = (one != other[:, ::-1]).any(1)
    places = uvs.detach().cpu().double().numpy()
    first, second = places[one[cut]], places[other[cut]][:, ::-1]  # edge, end, uv
    lengths = np.maximum(*(np.linalg.norm(np.diff(side, axis=1)[:, 0], axis=1) for side in (first, second)))
    counts = np.maximum(1, np.ceil(SAMPLES * lengths * size)).astype(np.int64)
    edge = np.repeat(np.arange(len(counts)), counts)
    share = ((np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts) + 0.5) / counts[edge])[:, None]
    return np.stack([side[edge, 0] * (1 - share) + side[edge, 1] * share for side in (first, second)], 1)


def seam_differences(texture: Float[Tensor, "h w 3"], points: Float[np.ndarray, "s 2 2"]) -> Float[np.ndarray, "s 3"]:
    """Return the absolute difference of the colors that bilinear reading finds on both sides of points on seams."""
    size = texture.shape[:2]
    colors = texture.detach().cpu().double().numpy().reshape(-1, 3)
    return np.asarray(np.abs((_reading(points[:, 0], size) - _reading(points[:, 1], size)) @ colors))


def level_seams(texture: Float[Tensor, "h w 3"], points: Float[np.ndarray, "s 2 2"]) -> Float[Tensor, "h w 3"]:
    """Correct the texels along seams so that both sides of a seam have the same colors.

    Args:
        texture: colors in [0, 1] of all texels, those around charts included.
        points: on all seams, of `seam_points`.
    """
    if len(points) == 0:
        return texture
    height, width = texture.shape[:2]
    across = _reading(points[:, 0], (height, width)) - _reading(points[:, 1], (height, width))
    touched = np.zeros(height * width, bool)
    touched[across.indices] = True
    near = ndimage.binary_dilation(touched.reshape(height, width), iterations=REACH)
    index = np.where(near, np.cumsum(near).reshape(near.shape) - 1, -1)
    count = int(near.sum())
    horizontal, vertical = (index[:, 1:], index[:, :-1]), (index[1:], index[:-1])
    pairs = [
        np.stack([one[inside], other[inside]])
        for one, other in (horizontal, vertical)
        for inside in [(one >= 0) & (other >= 0)]
    ]
    rows, columns = np.concatenate(pairs, 1)
    beside = coo_array((np.full(len(rows), SMOOTHNESS), (rows, columns)), shape=(count, count)).tocsr()
    colors = texture.detach().cpu().double().numpy()
    mismatch = across @ colors.reshape(-1, 3)
    across = csr_array(across[:, near.ravel()])
    own = diags_array(np.full(count, FIDELITY + 4 * SMOOTHNESS))  # texels beyond the reach keep their colors
    matrix = csr_array(across.T @ across + own - beside - beside.T)
    scale = diags_array(1 / matrix.diagonal())
    corrected = colors.copy()
    for channel in range(3):
        correction, _ = cg(matrix, -(across.T @ mismatch[:, channel]), rtol=1e-2, maxiter=ITERATIONS, M=scale)
        corrected[near, channel] += correction
    return torch.from_numpy(corrected.clip(0, 1)).to(texture)


def _reading(uvs: Float[np.ndarray, "s 2"], size: tuple[int, ...]) -> csr_array:
    """Return the matrix from texels to bilinear readings; texel centers are at (index + 0.5) / size."""
    height, width = size
    x = np.clip(uvs[:, 0] * width - 0.5, 0, width - 1)
    y = np.clip(uvs[:, 1] * height - 0.5, 0, height - 1)
    left, top = np.minimum(x.astype(np.int64), width - 2), np.minimum(y.astype(np.int64), height - 2)
    a, b = x - left, y - top
    corners = [(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b]
    first = top * width + left
    columns = np.stack([first, first + 1, first + width, first + width + 1], 1)
    rows = np.repeat(np.arange(len(uvs)), 4)
    return coo_array((np.stack(corners, 1).ravel(), (rows, columns.ravel())), shape=(len(uvs), height * width)).tocsr()
