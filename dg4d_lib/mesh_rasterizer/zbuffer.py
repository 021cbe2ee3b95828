"""Which triangle of a mesh lies under every pixel: a z-buffer without gradients.

A pixel belongs to the triangle that holds its center (column + 0.5, row + 0.5), from either side; the nearest one wins,
of equally near ones the one that stands first in `faces`. Edges belong to both neighbors: a closed mesh has no cracks.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Float64, Int, Int32
from numba import njit
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.kernels.workers import run

NEAR = 0.2  # world units of camera z; a triangle with a nearer corner is not drawn
EDGE = 1e-9  # how far outside of a triangle still counts as its edge, in barycentric coordinates: float64 noise
TIE = 1e-9  # relative difference of 1/z below which two triangles are equally near: float64 noise


@dataclass(frozen=True)
class Fragments:
    """What every pixel sees.

    Attributes:
        faces: index of the visible triangle, -1 where there is none.
        barycentrics: weights of that triangle's corners in space (perspective correct), with sum 1; 0 where none is.
        depth: camera z of the visible point, world units; 0 where there is none.
    """

    faces: Int32[Tensor, "b h w"]
    barycentrics: Float[Tensor, "b h w 3"]
    depth: Float[Tensor, "b h w"]


def rasterize_mesh(
    vertices: Float[Tensor, "*b v 3"], faces: Int[Tensor, "f 3"], cameras: Sequence[OrbitCamera]
) -> Fragments:
    """The visible triangle of every pixel of every camera.

    Args:
        vertices: world units; one mesh for all cameras ("v 3") or one state per camera ("b v 3").
        faces: indices into the vertices; orientation does not matter.
        cameras: b cameras of one width and height.

    Returns:
        Fragments on the device of the vertices; floats are float32.

    Raises:
        BadInput: no cameras, cameras of different sizes, or another number of states than cameras.
    """
    sizes = {(camera.height, camera.width) for camera in cameras}
    if len(sizes) != 1:
        raise BadInput(f"cameras of one drawing must have one size; given {sorted(sizes) or 'no camera'}")
    if vertices.ndim > 3 or (vertices.ndim == 3 and vertices.shape[0] != len(cameras)):
        raise BadInput(f"{len(cameras)} cameras need one mesh or {len(cameras)} states of it; given {vertices.shape}")
    (height, width), count = sizes.pop(), len(cameras)
    states = vertices.detach().to("cpu", torch.float64).numpy()
    triangles = np.ascontiguousarray(faces.detach().to("cpu", torch.int32).numpy())
    ids = np.empty((count, height, width), np.int32)
    weights = np.empty((count, height, width, 3), np.float32)
    depth = np.empty((count, height, width), np.float32)

    def draw(view: int) -> None:
        state = states if states.ndim == 2 else states[view]
        screen = _project(state, cameras[view])
        _draw(screen, triangles, ids[view], np.zeros((height, width)))
        _resolve(screen, triangles, ids[view], weights[view], depth[view])

    run([partial(draw, index) for index in range(count)])
    fragments = Fragments(torch.from_numpy(ids), torch.from_numpy(weights), torch.from_numpy(depth))
    return Fragments(**{name: value.to(vertices.device) for name, value in vars(fragments).items()})


def interpolate(
    fragments: Fragments, faces: Int[Tensor, "f 3"], attributes: Float[Tensor, "*b v c"]
) -> Float[Tensor, "b h w c"]:
    """Values of the vertices, spread over the pixels; differentiable in the attributes.

    Args:
        fragments: b drawings of the mesh.
        faces: as they were drawn.
        attributes: one set for all drawings ("v c") or one per drawing ("b v c").

    Returns:
        Weighted means of the corners' values; zeros where no triangle is.
    """
    covered = fragments.faces >= 0
    corners = faces.long()[fragments.faces[covered].long()]  # pixel, corner
    if attributes.ndim == 3:
        drawing = torch.nonzero(covered)[:, :1]
        values = attributes[drawing, corners]
    else:
        values = attributes[corners]
    weights = fragments.barycentrics[covered].to(attributes)
    result = attributes.new_zeros((*covered.shape, attributes.shape[-1]))
    result[covered] = (weights[..., None] * values).sum(-2)
    return result


def _project(vertices: Float64[np.ndarray, "v 3"], camera: OrbitCamera) -> Float64[np.ndarray, "v 3"]:
    """Column, row and 1/z of every vertex; 1/z is 0 for those nearer than NEAR."""
    pose = camera.world_to_camera().numpy()
    screen = np.empty((vertices.shape[0], 3))
    _project_points(vertices, pose, camera.focal, 0.5 * camera.width, 0.5 * camera.height, screen)
    return screen


@njit(nogil=True, cache=True)
@no_type_check
def _project_points(vertices, pose, focal, center_x, center_y, screen):
    for i in range(vertices.shape[0]):
        x, y, z = vertices[i, 0], vertices[i, 1], vertices[i, 2]
        depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        if not depth >= NEAR:  # also what is not a number
            screen[i, 0] = screen[i, 1] = screen[i, 2] = 0.0
            continue
        inverse = 1.0 / depth
        screen[i, 0] = center_x + focal * inverse * (pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3])
        screen[i, 1] = center_y + focal * inverse * (pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3])
        screen[i, 2] = inverse


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def _draw(screen, faces, ids, nearness):
    """Fill `ids` with the visible triangles; `nearness` starts as zeros and ends as 1/z, linear on the screen."""
    height, width = ids.shape
    ids[:] = -1
    for face in range(faces.shape[0]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        near_a, near_b, near_c = screen[a, 2], screen[b, 2], screen[c, 2]
        if near_a == 0 or near_b == 0 or near_c == 0:
            continue
        xa, ya, xb, yb, xc, yc = screen[a, 0], screen[a, 1], screen[b, 0], screen[b, 1], screen[c, 0], screen[c, 1]
        # the pixels whose centers lie in the triangle's box; clipped before the conversion, which may overflow
        left = int(np.ceil(max(min(xa, xb, xc) - 0.5 - EDGE, 0.0)))
        right = int(np.floor(min(max(xa, xb, xc) - 0.5 + EDGE, width - 1.0)))
        top = int(np.ceil(max(min(ya, yb, yc) - 0.5 - EDGE, 0.0)))
        bottom = int(np.floor(min(max(ya, yb, yc) - 0.5 + EDGE, height - 1.0)))
        if left > right or top > bottom:
            continue
        area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
        if area == 0:
            continue
        inverse = 1.0 / area
        ax, ay, bx, by = (yb - yc) * inverse, (xc - xb) * inverse, (yc - ya) * inverse, (xa - xc) * inverse
        for row in range(top, bottom + 1):
            dy = row + 0.5 - yc
            for column in range(left, right + 1):
                dx = column + 0.5 - xc
                weight_a = ax * dx + ay * dy
                weight_b = bx * dx + by * dy
                weight_c = 1.0 - weight_a - weight_b
                if weight_a >= -EDGE and weight_b >= -EDGE and weight_c >= -EDGE:
                    near = weight_a * near_a + weight_b * near_b + weight_c * near_c
                    if near > nearness[row, column] * (1.0 + TIE):
                        nearness[row, column] = near
                        ids[row, column] = face


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def _resolve(screen, faces, ids, weights, depth):
    """Perspective-correct weights and depth of the visible triangles."""
    height, width = ids.shape
    for row in range(height):
        for column in range(width):
            face = ids[row, column]
            if face < 0:
                weights[row, column, 0] = weights[row, column, 1] = weights[row, column, 2] = 0.0
                depth[row, column] = 0.0
                continue
            a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
            xa, ya, xb, yb, xc, yc = screen[a, 0], screen[a, 1], screen[b, 0], screen[b, 1], screen[c, 0], screen[c, 1]
            inverse = 1.0 / ((xb - xa) * (yc - ya) - (xc - xa) * (yb - ya))
            dx, dy = column + 0.5 - xc, row + 0.5 - yc
            flat_a = ((yb - yc) * dx + (xc - xb) * dy) * inverse
            flat_b = ((yc - ya) * dx + (xa - xc) * dy) * inverse
            near_a = max(flat_a, 0.0) * screen[a, 2]
            near_b = max(flat_b, 0.0) * screen[b, 2]
            near_c = max(1.0 - flat_a - flat_b, 0.0) * screen[c, 2]
            z = 1.0 / (near_a + near_b + near_c)
            weights[row, column, 0] = near_a * z
            weights[row, column, 1] = near_b * z
            weights[row, column, 2] = near_c * z
            depth[row, column] = z
