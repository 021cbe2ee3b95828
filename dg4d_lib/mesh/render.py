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
from dg4d_lib.mesh_rasterizer.zbuffer import interpolate, rasterize_mesh

SUPERSAMPLING = 3  # samples per pixel along each axis; odd, so that no pixel is covered by exactly half
LIGHT = (-0.4, -0.6, -0.7)  # direction towards the light, in the camera's axes (x right, y down, z forward)
AMBIENT, DIFFUSE = 0.5, 0.7  # a face turned 45 degrees from the light keeps its color


def render_mesh(
    mesh: TexturedMesh, cameras: Sequence[OrbitCamera], offsets: Float[Tensor, "*b v 3"] | None = None
) -> tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 1"]]:
    """Render color and alpha of a mesh with nine samples per pixel; differentiable in the texture.

    Args:
        mesh: the mesh at rest.
        cameras: b cameras of equal width and height.
        offsets: added to the vertices, world units; the same for all cameras ("v 3") or one state per camera ("b v 3").

    Returns:
        Straight color in [0, 1] (0 where alpha is 0) and alpha in ninths.

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


def render_lit(mesh: TexturedMesh, camera: OrbitCamera) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 1"]]:
    """Render a mesh under one distant light and ambient light, with smooth normals; folds and dents show.

    Returns:
        Straight color and alpha, in [0, 1].
    """
    color, alpha = render_mesh(mesh, [camera])
    fragments = rasterize_mesh(mesh.vertices, mesh.faces, [camera])
    shown = normalize(interpolate(fragments, mesh.faces, smooth_normals(mesh)), dim=-1)
    light = normalize(torch.tensor(LIGHT), dim=0).to(shown)
    cosine = ((shown @ camera.viewmat()[:3, :3].to(shown).T) * light).sum(-1, keepdim=True).clamp_min(0)
    return (color * (AMBIENT + DIFFUSE * cosine)).clamp(0, 1)[0], alpha[0]


def smooth_normals(mesh: TexturedMesh) -> Float[Tensor, "v 3"]:
    """Return area-weighted unit normals, equal on both sides of texture seams."""
    first, position = map(torch.from_numpy, group_vertices(mesh.vertices.numpy()))
    return vertex_normals(mesh.vertices[first], position[mesh.faces.long()])[position]


def _pooled(values: Float[Tensor, "b h w c"]) -> Float[Tensor, "b i j c"]:
    return avg_pool2d(values.movedim(-1, 1), SUPERSAMPLING).movedim(1, -1)
