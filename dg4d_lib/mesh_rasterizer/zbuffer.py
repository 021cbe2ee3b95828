"""Which triangle of a mesh lies under every pixel: a z-buffer without gradients.

A pixel belongs to the triangle that holds its center (column + 0.5, row + 0.5), from either side; the nearest one wins,
of equally near ones the one that stands first in `faces`. A closed mesh has no cracks. Processors and other devices
draw the same.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, Int32
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.mesh_rasterizer import scanlines, scanlines_cpu


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
    form = scanlines_cpu if vertices.device.type == "cpu" else scanlines
    return Fragments(*form.draw(vertices, faces.to(vertices.device), cameras))


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
