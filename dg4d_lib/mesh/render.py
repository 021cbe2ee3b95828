"""Renders of a textured mesh, unlit and lit."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.geometry.normals import vertex_normals
from dg4d_lib.mesh.extraction.topology import group_labels, group_vertices
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh_rasterizer.texture import build_lookup, sample_texture
from dg4d_lib.mesh_rasterizer.texture_cpu import MipLevels, Rasterized, mip_levels, texture_colors
from dg4d_lib.mesh_rasterizer.zbuffer import interpolate, rasterize_mesh

SUPERSAMPLING = 3  # default samples per pixel along each axis; odd, so that no pixel is covered by exactly half
LIGHT = (-0.4, -0.6, -0.7)  # direction towards the light, in the camera's axes (x right, y down, z forward)
AMBIENT, DIFFUSE = 0.5, 0.7  # a face turned 45 degrees from the light keeps its color


class VertexGroups(NamedTuple):
    """Vertices that share a normal: copies of one vertex along texture seams.

    Attributes:
        first: one vertex of every group.
        group: group of every vertex.
    """

    first: Int[Tensor, " w"]
    group: Int[Tensor, " v"]


class LitRenderer:
    """Renders under one distant light and ambient light, with smooth normals; folds and dents show.

    The seams and mip levels of the last mesh are kept, for later states of it: meshes that share the tensor `faces` or
    `texture`.
    """

    def __init__(self, supersampling: int = SUPERSAMPLING) -> None:
        """Store the number of samples per pixel along each axis."""
        self._supersampling = supersampling
        self._groups: tuple[Tensor, VertexGroups] | None = None  # with the faces
        self._mips: tuple[Tensor, MipLevels] | None = None  # with the texture

    def render(self, mesh: TexturedMesh, camera: OrbitCamera) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 1"]]:
        """Return straight color and alpha, in [0, 1]."""
        towards = normalize(torch.tensor(LIGHT, dtype=torch.float64), dim=0) @ camera.viewmat()[:3, :3]
        normals = smooth_normals(mesh, self._groups_of(mesh))
        light = AMBIENT + DIFFUSE * (normals @ towards.to(mesh.vertices)).clamp_min(0)
        color, alpha = _render(mesh, mesh.vertices, [camera], light, self._supersampling, self._mips_of)
        return color[0], alpha[0]

    def _groups_of(self, mesh: TexturedMesh) -> VertexGroups:
        if self._groups is not None and self._groups[0] is mesh.faces:
            groups = self._groups[1]
            if torch.equal(mesh.vertices[groups.first][groups.group], mesh.vertices):  # no seam has opened
                return groups
        groups = vertex_groups(mesh)
        self._groups = mesh.faces, groups
        return groups

    def _mips_of(self, texture: Float[Tensor, "y x 3"]) -> MipLevels:
        if self._mips is None or self._mips[0] is not texture:
            self._mips = texture, mip_levels(texture)
        return self._mips[1]


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


def _render(
    mesh: TexturedMesh,
    vertices: Float[Tensor, "*b v 3"],
    cameras: Sequence[OrbitCamera],
    light: Float[Tensor, " v"] | None,
    side: int,
    mips_of: Callable[[Tensor], MipLevels] = mip_levels,
) -> tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 1"]]:
    """Return straight color and alpha of pixels of several samples a side, under a light if vertices have one."""
    fine = [replace(camera, width=side * camera.width, height=side * camera.height) for camera in cameras]
    fragments = rasterize_mesh(vertices, mesh.faces, fine)
    with_gradients = torch.is_grad_enabled() and mesh.texture.requires_grad
    if vertices.device.type == "cpu" and mesh.texture.dtype == torch.float32 and not with_gradients:
        rasterized = Rasterized(vertices, mesh.faces, mesh.uvs, fine, fragments)
        return texture_colors(rasterized, mips_of(mesh.texture), light, side)
    lookup = build_lookup(vertices, mesh.faces, mesh.uvs, mesh.texture.shape[:2], fine, fragments)
    samples = mesh.texture.new_zeros((*lookup.covered.shape, 3))
    samples[lookup.covered] = sample_texture(mesh.texture, lookup)
    if light is not None:
        samples = (samples * interpolate(fragments, mesh.faces, light[:, None])).clamp(0, 1)
    covered = lookup.covered[..., None].to(samples)
    color, alpha = (avg_pool2d(each.movedim(-1, 1), side).movedim(1, -1) for each in (samples, covered))
    return color / alpha.clamp_min(0.5 / side**2), alpha


def smooth_normals(mesh: TexturedMesh, groups: VertexGroups | None = None) -> Float[Tensor, "v 3"]:
    """Return area-weighted unit normals, equal on both sides of texture seams.

    Args:
        mesh: the mesh.
        groups: its `vertex_groups`; None: they are found.
    """
    first, group = groups or vertex_groups(mesh)
    return vertex_normals(mesh.vertices[first], group[mesh.faces.long()])[group]


def vertex_groups(mesh: TexturedMesh) -> VertexGroups:
    """Return which vertices of a mesh have equal positions, and are in one smoothing group."""
    first, group = group_vertices(mesh.vertices.numpy())
    if mesh.smoothing_groups is not None:
        first, group = group_labels(group, mesh.smoothing_groups.numpy())
    return VertexGroups(torch.from_numpy(first), torch.from_numpy(group))
