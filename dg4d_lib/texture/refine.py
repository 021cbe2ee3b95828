"""A texture follows better pictures of the moving mesh (METHOD section 9)."""

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.mesh.render import sample
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh_rasterizer.zbuffer import interpolate, rasterize_mesh
from dg4d_lib.texture.refiner import Refiner

SIZE = 512  # pixels of the pictures that are refined
ITERATIONS = 4  # of the texture after the pictures; the error of a smooth change halves in each


def refine_texture(
    mesh: TexturedMesh, offsets: Float[Tensor, "t v 3"], refiner: Refiner, size: int = SIZE
) -> Float[Tensor, "h w 3"]:
    """The texture that shows the refined video of the moving mesh, seen from the input view over white.

    Args:
        mesh: at rest.
        offsets: what to add to the vertices at every frame, world units.
        refiner: makes the video better; where it changes nothing, nor does the texture.
        size: pixels of the video.

    Returns:
        Colors in [0, 1]; texels that the input view never shows are as they were.
    """
    cameras = [OrbitCamera(width=size, height=size)] * len(offsets)
    fragments = rasterize_mesh(mesh.vertices + offsets, mesh.faces, cameras)
    covered = fragments.faces >= 0
    places = interpolate(fragments, mesh.faces, mesh.uvs)[covered]
    video = torch.ones(*covered.shape, 3)
    video[covered] = sample(mesh.texture, places)
    wanted = refiner.refine(video)[covered]
    texture = mesh.texture
    for _ in range(ITERATIONS):
        error = wanted - sample(texture, places)
        if not error.any():
            break
        texture = texture + _mean_on_texels(texture, places, error)
    return texture.clamp(0, 1)


def _mean_on_texels(
    texture: Float[Tensor, "h w 3"], places: Float[Tensor, "n 2"], values: Float[Tensor, "n 3"]
) -> Float[Tensor, "h w 3"]:
    """What the samples say that read a texel, weighted as they read it; zero where none does."""
    canvas = torch.zeros_like(texture, requires_grad=True)
    read = sample(canvas, places)
    total = torch.autograd.grad(read, canvas, values, retain_graph=True)[0]
    weight = torch.autograd.grad(read, canvas, torch.ones_like(values))[0]
    return torch.where(weight > 0, total / weight.clamp_min(1e-6), torch.zeros_like(total))
