"""Unlit renders of a textured mesh."""

from collections.abc import Sequence
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh_rasterizer.texture import build_lookup, sample_texture
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh

SUPERSAMPLING = 2  # samples per pixel along each axis


def render_mesh(
    mesh: TexturedMesh, cameras: Sequence[OrbitCamera], offsets: Float[Tensor, "*b v 3"] | None = None
) -> tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 1"]]:
    """Render color and alpha of a mesh with four samples per pixel; differentiable in the texture.

    Args:
        mesh: the mesh at rest.
        cameras: b cameras of equal width and height.
        offsets: added to the vertices, world units; the same for all cameras ("v 3") or one state per camera ("b v 3").

    Returns:
        Straight color in [0, 1] (0 where alpha is 0) and alpha in {0, 1/4, 1/2, 3/4, 1}.

    Raises:
        BadInput: no cameras, cameras of different sizes, or a number of mesh states that differs from the number of
            cameras.
    """
    fine = [
        replace(camera, width=SUPERSAMPLING * camera.width, height=SUPERSAMPLING * camera.height) for camera in cameras
    ]
    vertices = mesh.vertices if offsets is None else mesh.vertices + offsets
    fragments = rasterize_mesh(vertices, mesh.faces, fine)
    lookup = build_lookup(vertices, mesh.faces, mesh.uvs, mesh.texture.shape[:2], fine, fragments)
    samples = mesh.texture.new_zeros((*lookup.covered.shape, 3))
    samples[lookup.covered] = sample_texture(mesh.texture, lookup)
    color, alpha = _pooled(samples), _pooled(lookup.covered[..., None].to(samples))
    return color / alpha.clamp_min(0.5 / SUPERSAMPLING**2), alpha


def _pooled(values: Float[Tensor, "b h w c"]) -> Float[Tensor, "b i j c"]:
    return avg_pool2d(values.movedim(-1, 1), SUPERSAMPLING).movedim(1, -1)
