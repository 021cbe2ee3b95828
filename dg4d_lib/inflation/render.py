"""Rendering of inflated surfaces."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.kernels.compiling import njit
from dg4d_lib.kernels.workers import run_parallel
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh


def render_surface(
    surfaces: InflatedSurface | Sequence[InflatedSurface], cameras: Sequence[OrbitCamera], supersample: int = 2
) -> tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 1"]]:
    """Render surfaces for b cameras of one size.

    Args:
        surfaces: one for all cameras, or one per camera.
        cameras: poses and picture size.
        supersample: samples per pixel and axis.

    Returns:
        Straight color in [0, 1] (0 where nothing is) and alpha in [0, 1].

    Raises:
        BadInput: cameras of different sizes, none, or another number of surfaces than cameras.
    """
    each = [surfaces] * len(cameras) if isinstance(surfaces, InflatedSurface) else list(surfaces)
    sizes = {(camera.height, camera.width) for camera in cameras}
    if len(sizes) != 1 or len(each) != len(cameras):
        raise BadInput(
            f"{len(each)} surfaces and {len(cameras)} cameras of sizes {sorted(sizes)}: one size is needed, "
            "and one surface or as many as cameras"
        )
    height, width = sizes.pop()
    planes = np.empty((len(cameras), 4, height, width), np.float32)

    def draw(view: int) -> None:
        surface, camera = each[view], cameras[view]
        fine = replace(camera, width=width * supersample, height=height * supersample)
        fragments = rasterize_mesh(surface.vertices, surface.faces, [fine])
        _shade(
            fragments.faces[0].cpu().numpy(),
            fragments.barycentrics[0].cpu().numpy(),
            surface.faces.cpu().numpy(),
            surface.colors.cpu().numpy(),
            supersample,
            planes[view],
        )

    # one camera in each job: the z-buffer inside does not wait for the same threads
    run_parallel([partial(draw, index) for index in range(len(cameras))])
    pictures = torch.from_numpy(planes).to(each[0].vertices.device).movedim(1, -1)
    return pictures[..., :3], pictures[..., 3:]


@njit(nogil=True, cache=True)
@no_type_check
def _shade(ids, weights, faces, colors, supersample, planes):
    """Interpolate the corners' colors and average the samples of every pixel; the last plane is alpha."""
    for row in range(planes.shape[1]):
        for column in range(planes.shape[2]):
            red = green = blue = 0.0
            hits = 0
            for y in range(row * supersample, (row + 1) * supersample):
                for x in range(column * supersample, (column + 1) * supersample):
                    face = ids[y, x]
                    if face < 0:
                        continue
                    hits += 1
                    for corner in range(3):
                        weight, vertex = weights[y, x, corner], faces[face, corner]
                        red += weight * colors[vertex, 0]
                        green += weight * colors[vertex, 1]
                        blue += weight * colors[vertex, 2]
            share = 1.0 / max(hits, 1)
            planes[0, row, column] = red * share
            planes[1, row, column] = green * share
            planes[2, row, column] = blue * share
            planes[3, row, column] = hits / supersample**2
