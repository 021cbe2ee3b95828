"""Renders of a textured mesh, unlit and lit."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.geometry.normals import vertex_normals
from dg4d_lib.mesh.extraction.topology import group_vertices
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh_rasterizer.texture import build_lookup, sample_texture
from dg4d_lib.mesh_rasterizer.texture_cpu import Rasterized, texture_colors
from dg4d_lib.mesh_rasterizer.zbuffer import interpolate, rasterize_mesh

SUPERSAMPLING = 3  # samples per pixel along each axis, unless told; odd, so that no pixel is covered by exactly half
LIGHT = (-0.4, -0.6, -0.7)  # direction towards the light, in the camera's axes (x right, y down, z forward)
AMBIENT, DIFFUSE = 0.5, 0.7  # a face turned 45 degrees from the light keeps its color


def render_mesh(
    mesh: TexturedMesh,
    cameras: Sequence[OrbitCamera],
    offsets: Float[Tensor, "*b v 3"] | None = None,
    supersampling: int = SUPERSAMPLING,
) -> tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 1"]]:
    """Render color and alpha of a mesh with several samples per pixel; differentiable in the texture.

    Args:
        mesh: the mesh at rest.
        cameras: b cameras of equal width and height.
        offsets: added to the vertices, world units; the same for all cameras ("v 3") or one state per camera ("b v 3").
        supersampling: samples per pixel along each axis.

    Returns:
        Straight color in [0, 1] (0 where alpha is 0) and alpha: the share of the samples that show the mesh.

    Raises:
        BadInput: no cameras, cameras of different sizes, or a number of mesh states that differs from the number of
            cameras.
    """
    vertices = mesh.vertices if offsets is None else mesh.vertices + offsets
    return _render(mesh, vertices, cameras, None, supersampling)


def render_lit(
    mesh: TexturedMesh, camera: OrbitCamera, supersampling: int = SUPERSAMPLING
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 1"]]:
    """Render a mesh under one distant light and ambient light, with smooth normals; folds and dents show.

    Args:
        mesh: the mesh.
        camera: the camera.
        supersampling: samples per pixel along each axis.

    Returns:
        Straight color and alpha, in [0, 1].
    """
    towards = normalize(torch.tensor(LIGHT, dtype=torch.float64), dim=0) @ camera.viewmat()[:3, :3]
    light = AMBIENT + DIFFUSE * (smooth_normals(mesh) @ towards.to(mesh.vertices)).clamp_min(0)
    color, alpha = _render(mesh, mesh.vertices, [camera], light, supersampling)
    return color[0], alpha[0]


def _render(
    mesh: TexturedMesh,
    vertices: Float[Tensor, "*b v 3"],
    cameras: Sequence[OrbitCamera],
    light: Float[Tensor, " v"] | None,
    side: int,
) -> tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 1"]]:
    """Return straight color and alpha of pixels of several samples a side, under a light if vertices have one."""
    fine = [replace(camera, width=side * camera.width, height=side * camera.height) for camera in cameras]
    fragments = rasterize_mesh(vertices, mesh.faces, fine)
    with_gradients = torch.is_grad_enabled() and mesh.texture.requires_grad
    if vertices.device.type == "cpu" and mesh.texture.dtype == torch.float32 and not with_gradients:
        return texture_colors(Rasterized(vertices, mesh.faces, mesh.uvs, fine, fragments), mesh.texture, light, side)
    lookup = build_lookup(vertices, mesh.faces, mesh.uvs, mesh.texture.shape[:2], fine, fragments)
    samples = mesh.texture.new_zeros((*lookup.covered.shape, 3))
    samples[lookup.covered] = sample_texture(mesh.texture, lookup)
    if light is not None:
        samples = (samples * interpolate(fragments, mesh.faces, light[:, None])).clamp(0, 1)
    covered = lookup.covered[..., None].to(samples)
    color, alpha = (avg_pool2d(each.movedim(-1, 1), side).movedim(1, -1) for each in (samples, covered))
    return color / alpha.clamp_min(0.5 / side**2), alpha


def smooth_normals(mesh: TexturedMesh) -> Float[Tensor, "v 3"]:
    """Return area-weighted unit normals, equal on both sides of texture seams."""
    first, position = map(torch.from_numpy, group_vertices(mesh.vertices.numpy()))
    return vertex_normals(mesh.vertices[first], position[mesh.faces.long()])[position]
