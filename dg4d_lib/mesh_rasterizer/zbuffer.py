"""Z-buffer rasterization of triangle meshes, without gradients, and interpolation of vertex attributes.

A pixel shows the nearest triangle that contains its center (column + 0.5, row + 0.5), front or back facing; of equally
near triangles the first in `faces` wins. A closed mesh has no cracks. The CPU and the torch backend give equal results.
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
    """Rasterizer output: the visible triangle of every pixel.

    Attributes:
        faces: index of the visible triangle; -1 where there is none.
        barycentrics: perspective-correct weights of its corners, sum 1; 0 where there is no triangle.
        depth: camera z of the visible point, world units; 0 where there is no triangle.
    """

    faces: Int32[Tensor, "b h w"]
    barycentrics: Float[Tensor, "b h w 3"]
    depth: Float[Tensor, "b h w"]


def rasterize_mesh(
    vertices: Float[Tensor, "*b v 3"], faces: Int[Tensor, "f 3"], cameras: Sequence[OrbitCamera]
) -> Fragments:
    """Rasterize a mesh: find the visible triangle of every pixel of every camera.

    Args:
        vertices: world units; one mesh for all cameras ("v 3") or one state per camera ("b v 3").
        faces: indices into the vertices; orientation does not matter.
        cameras: b cameras of equal width and height.

    Returns:
        Fragments on the device of the vertices; floats are float32.

    Raises:
        BadInput: no cameras, cameras of different sizes, or a number of mesh states that differs from the number of
            cameras.
    """
    sizes = {(camera.height, camera.width) for camera in cameras}
    if len(sizes) != 1:
        raise BadInput(f"all cameras of one call must have the same size; given {sorted(sizes) or 'no cameras'}")
    if vertices.ndim > 3 or (vertices.ndim == 3 and vertices.shape[0] != len(cameras)):
        raise BadInput(
            f"{len(cameras)} cameras need vertices of shape (v, 3) or ({len(cameras)}, v, 3); "
            f"given {tuple(vertices.shape)}"
        )
    backend = scanlines_cpu if vertices.device.type == "cpu" else scanlines
    return Fragments(*backend.rasterize(vertices, faces.to(vertices.device), cameras))


def interpolate(
    fragments: Fragments, faces: Int[Tensor, "f 3"], attributes: Float[Tensor, "*b v c"]
) -> Float[Tensor, "b h w c"]:
    """Interpolate vertex attributes at the pixels; differentiable in the attributes.

    Args:
        fragments: b images of the mesh.
        faces: the faces that were rasterized.
        attributes: one set for all images ("v c") or one per image ("b v c").

    Returns:
        Barycentric means of the corner values; zeros where there is no triangle.
    """
    covered = fragments.faces >= 0
    corners = faces.long()[fragments.faces[covered].long()]  # pixel, corner
    if attributes.ndim == 3:
        image = torch.nonzero(covered)[:, :1]
        values = attributes[image, corners]
    else:
        values = attributes[corners]
    weights = fragments.barycentrics[covered].to(attributes)
    result = attributes.new_zeros((*covered.shape, attributes.shape[-1]))
    result[covered] = (weights[..., None] * values).sum(-2)
    return result
