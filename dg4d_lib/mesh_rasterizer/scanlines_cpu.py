"""Scan-line rasterization as Numba kernels for CPUs; algorithm and results are those of `scanlines`.

Each view is one job of the thread pool, so the number of threads does not change the result.
"""

from collections.abc import Sequence
from functools import partial
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Float32, Int, Int32
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.kernels.compiling import njit
from dg4d_lib.kernels.workers import Scratch, run_parallel
from dg4d_lib.mesh_rasterizer.scanlines import DEPTH_STEPS, EMPTY, FAR_OFF, NEAR

_COMPILED = {"nogil": True, "cache": True, "error_model": "numpy"}  # no fastmath: neighbors must get equal crossings


def rasterize(
    vertices: Float[Tensor, "*b v 3"], faces: Int[Tensor, "f 3"], cameras: Sequence[OrbitCamera]
) -> tuple[Int32[Tensor, "b h w"], Float32[Tensor, "b h w 3"], Float32[Tensor, "b h w"]]:
    """Return faces, barycentric coordinates and depth per pixel, as in `Fragments`."""
    shape = len(cameras), cameras[0].height, cameras[0].width
    states = vertices.detach().double().contiguous().numpy()
    triangles = np.ascontiguousarray(faces.int().numpy())
    ids = np.empty(shape, np.int32)
    weights, depth = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32)

    def draw_view(view: int) -> None:
        state, camera, scratch = states if states.ndim == 2 else states[view], cameras[view], Scratch()
        screen, lines = scratch.empty((len(state), 3), np.float64), scratch.empty((len(state),), np.int32)
        keys = scratch.empty(shape[1:], np.int64)
        _project(state, camera.viewmat().numpy(), camera.focal, keys, screen, lines)
        _draw(screen, lines, triangles, keys)
        _resolve(screen, triangles, keys, ids[view], weights[view], depth[view])

    run_parallel([partial(draw_view, view) for view in range(len(cameras))])
    return torch.from_numpy(ids), torch.from_numpy(weights), torch.from_numpy(depth)


@njit(**_COMPILED)
@no_type_check
def _project(vertices, pose, focal, keys, screen, lines):
    """Write column, row and 1/z of every vertex (zeros if it cannot be drawn), and the first row below it."""
    height, width = keys.shape
    for i in range(vertices.shape[0]):
        x, y, z = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        far = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        near = 1.0 / far
        column = 0.5 * width + focal * near * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3])
        row = 0.5 * height + focal * near * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3])
        if not (far >= NEAR and abs(column) < FAR_OFF and abs(row) < FAR_OFF):  # True for NaN, too
            column = row = near = 0.0
        screen[i, 0], screen[i, 1], screen[i, 2] = column, row, near
        lines[i] = int(np.ceil(row - 0.5))


@njit(**_COMPILED)
@no_type_check
def _draw(screen, lines, faces, keys):
    """Fill `keys` with the smallest key of every pixel."""
    height, width = keys.shape
    keys[:] = EMPTY
    for face in range(faces.shape[0]):
        t, m, b = faces[face, 0], faces[face, 1], faces[face, 2]  # sorted below to top, middle and bottom corner
        line_t, line_m, line_b = lines[t], lines[m], lines[b]
        if line_t == line_m == line_b:
            continue
        if screen[t, 1] > screen[m, 1]:
            t, m, line_t, line_m = m, t, line_m, line_t
        if screen[m, 1] > screen[b, 1]:
            m, b, line_m, line_b = b, m, line_b, line_m
        if screen[t, 1] > screen[m, 1]:
            t, m, line_t, line_m = m, t, line_m, line_t
        xt, yt, near_t = screen[t, 0], screen[t, 1], screen[t, 2]
        xm, ym, near_m = screen[m, 0], screen[m, 1], screen[m, 2]
        xb, yb, near_b = screen[b, 0], screen[b, 1], screen[b, 2]
        if near_t == 0 or near_m == 0 or near_b == 0:
            continue
        # Change of column and 1/z per row along the edges; infinite only where no row crosses the edge.
        inverse_long, inverse_above, inverse_below = 1.0 / (yb - yt), 1.0 / (ym - yt), 1.0 / (yb - ym)
        x_long, near_long = (xb - xt) * inverse_long, (near_b - near_t) * inverse_long
        x_above, near_above = (xm - xt) * inverse_above, (near_m - near_t) * inverse_above
        x_below, near_below = (xb - xm) * inverse_below, (near_b - near_m) * inverse_below
        for row in range(max(line_t, 0), min(line_b, height)):
            down = row + 0.5 - yt
            left, near_left = xt + down * x_long, near_t + down * near_long
            if row < line_m:
                right, near_right = xt + down * x_above, near_t + down * near_above
            else:
                down = row + 0.5 - ym
                right, near_right = xm + down * x_below, near_m + down * near_below
            if left > right:
                left, right, near_left, near_right = right, left, near_right, near_left
            start = int(np.ceil(min(max(left - 0.5, 0.0), width)))
            end = int(np.ceil(min(max(right - 0.5, 0.0), width)))
            if start >= end:
                continue
            slope = (near_right - near_left) / (right - left)
            for column in range(start, end):
                near = near_left + (column + 0.5 - left) * slope
                key = (np.int64((1.0 - NEAR * near) * DEPTH_STEPS) << 32) | face
                keys[row, column] = min(keys[row, column], key)


@njit(**_COMPILED)
@no_type_check
def _resolve(screen, faces, keys, ids, weights, depth):
    """Decode `keys` to faces, perspective-correct barycentrics and depth; `weights` and `depth` start as zeros."""
    height, width = keys.shape
    for row in range(height):
        for column in range(width):
            if keys[row, column] == EMPTY:
                ids[row, column] = -1
                continue
            face = keys[row, column] & 0xFFFFFFFF
            ids[row, column] = face
            a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
            x, y = column + 0.5, row + 0.5
            xa, xb, xc = screen[a, 0] - x, screen[b, 0] - x, screen[c, 0] - x
            ya, yb, yc = screen[a, 1] - y, screen[b, 1] - y, screen[c, 1] - y
            area_a, area_b, area_c = xb * yc - xc * yb, xc * ya - xa * yc, xa * yb - xb * ya
            if area_a + area_b + area_c < 0:
                area_a, area_b, area_c = -area_a, -area_b, -area_c
            area_a, area_b, area_c = max(area_a, 0.0), max(area_b, 0.0), max(area_c, 0.0)
            if area_a + area_b + area_c == 0:  # edge-on triangle
                area_a = area_b = area_c = 1.0
            share_a, share_b, share_c = area_a * screen[a, 2], area_b * screen[b, 2], area_c * screen[c, 2]
            total = share_a + share_b + share_c
            weights[row, column, 0] = share_a / total
            weights[row, column, 1] = share_b / total
            weights[row, column, 2] = share_c / total
            depth[row, column] = (area_a + area_b + area_c) / total
