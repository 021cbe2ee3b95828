"""Places on a texture that covered pixels show, as Numba kernels for CPUs; results are those of `texture`.

Each view is one job of the thread pool, so the number of threads does not change the result.
"""

from collections.abc import Sequence
from functools import partial
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from numba import njit
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.kernels.workers import run_parallel
from dg4d_lib.mesh_rasterizer.zbuffer import Fragments


def texture_places(
    vertices: Float[Tensor, "*b v 3"],
    faces: Int[Tensor, "f 3"],
    uvs: Float[Tensor, "v 2"],
    size: Sequence[int],
    cameras: Sequence[OrbitCamera],
    fragments: Fragments,
) -> tuple[Float32[Tensor, "p 2"], Float32[Tensor, " p"]]:
    """Return texture coordinates and mip levels of all covered pixels; arguments are those of `build_lookup`."""
    states, coordinates = vertices.detach().double().numpy(), uvs.detach().double().numpy()
    triangles = np.ascontiguousarray(faces.int().numpy())
    ids, weights = fragments.faces.numpy(), fragments.barycentrics.detach().numpy()
    starts = np.concatenate([[0], (ids >= 0).sum((1, 2)).cumsum()])
    places, levels = np.empty((starts[-1], 2), np.float32), np.empty(starts[-1], np.float32)

    def place_view(view: int) -> None:
        pose, camera, part = cameras[view].viewmat().numpy(), cameras[view], slice(*starts[view : view + 2])
        seen = (states if states.ndim == 2 else states[view]) @ pose[:3, :3].T + pose[:3, 3]
        texels = float(size[1]), float(size[0])
        _place(
            seen, triangles, coordinates, texels, camera.focal, ids[view], weights[view], places[part], levels[part]
        )  # fmt: skip

    run_parallel([partial(place_view, view) for view in range(len(cameras))])
    return torch.from_numpy(places), torch.from_numpy(levels)


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def _place(vertices, faces, uvs, texels, focal, ids, weights, places, levels):
    """Write texture coordinates and mip level of every covered pixel, row by row; see `texture` for the formulas."""
    height, width = ids.shape
    pixel = 0
    for row in range(height):
        y = (row + 0.5 - 0.5 * height) / focal
        for column in range(width):
            if ids[row, column] < 0:
                continue
            x = (column + 0.5 - 0.5 * width) / focal
            u = v = 0.0
            for k in range(3):
                corner, weight = faces[ids[row, column], k], np.float64(weights[row, column, k])
                u += weight * uvs[corner, 0]
                v += weight * uvs[corner, 1]
            total = u_right = v_right = u_down = v_down = 0.0
            for k in range(3):
                corner = faces[ids[row, column], k]
                b, c = faces[ids[row, column], (k + 1) % 3], faces[ids[row, column], (k + 2) % 3]
                bx, by, bz = vertices[b, 0], vertices[b, 1], vertices[b, 2]
                cx, cy, cz = vertices[c, 0], vertices[c, 1], vertices[c, 2]
                right, down = by * cz - bz * cy, bz * cx - bx * cz
                total += right * x + down * y + bx * cy - by * cx
                u_right += right * (uvs[corner, 0] - u)
                v_right += right * (uvs[corner, 1] - v)
                u_down += down * (uvs[corner, 0] - u)
                v_down += down * (uvs[corner, 1] - v)
            along_u, along_v = u_right * u_right + u_down * u_down, v_right * v_right + v_down * v_down
            square = (along_u * texels[0] ** 2 + along_v * texels[1] ** 2) / (focal * total) ** 2
            places[pixel, 0], places[pixel, 1] = u, v
            levels[pixel] = 0.5 * np.log2(square / 6)
            pixel += 1
