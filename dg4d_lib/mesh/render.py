"""Pictures of a textured mesh: unlit, the texture as it is."""

from collections.abc import Sequence
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh_rasterizer.texture import look_up, read
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh

SUPERSAMPLING = 2  # samples of a pixel along each axis


def render_mesh(
    mesh: TexturedMesh, cameras: Sequence[OrbitCamera], offsets: Float[Tensor, "*b v 3"] | None = None
) -> tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 1"]]:
    """Color and coverage of a mesh, four samples a pixel; differentiable in the texture.

    Args:
        mesh: at rest.
        cameras: b cameras of one width and height.
        offsets: added to the vertices, world units; the same for all cameras ("v 3") or one state per camera ("b v 3").

    Returns:
        Straight color in [0, 1] (0 where nothing is) and coverage in {0, 1/4, 1/2, 3/4, 1}.

    Raises:
        BadInput: no cameras, cameras of different sizes, or another number of states than cameras.
    """
    fine = [
        replace(camera, width=SUPERSAMPLING * camera.width, height=SUPERSAMPLING * camera.height) for camera in cameras
    ]
    vertices = mesh.vertices if offsets is None else mesh.vertices + offsets
    fragments = rasterize_mesh(vertices, mesh.faces, fine)
    lookup = look_up(vertices, mesh.faces, mesh.uvs, mesh.texture.shape[:2], fine, fragments)
    samples = mesh.texture.new_zeros((*lookup.covered.shape, 3))
    samples[lookup.covered] = read(mesh.texture, lookup)
    color, coverage = _pooled(samples), _pooled(lookup.covered[..., None].to(samples))
    return color / coverage.clamp_min(0.5 / SUPERSAMPLING**2), coverage


def _pooled(values: Float[Tensor, "b h w c"]) -> Float[Tensor, "b i j c"]:
    return avg_pool2d(values.movedim(-1, 1), SUPERSAMPLING).movedim(1, -1)
