"""Colors of the far side of a symmetric mesh, taken in full detail from its near side across the mirror plane.

A texel that no frame shows takes the color that the input view shows at its mirror image, where there is a surface.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.mesh.render import render_mesh, smooth_normals
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh.texturing.bake import (
    INPUT_MIN_COSINE,
    LAST_RESORT,
    OUTLINE,
    CoveredTexels,
    PosedSurface,
    Texels,
    add_footage,
    add_views,
    covered_texels,
    fill_texture,
    grade_pixels,
    placed_texels,
)
from dg4d_lib.mesh.texturing.seams import level_seams, seam_points
from dg4d_lib.mesh_rasterizer.zbuffer import interpolate, rasterize_mesh
from dg4d_lib.shape_prior.mirror import MirrorPlane

REACH = 0.12  # world units along a ray of the input camera: a mirror image further from the surface shows nothing
LEAST_AGREEMENT = 0.5  # cosine between the normals of mirror image and surface; below it, it is another part's surface
SHOWN = 1 / LAST_RESORT  # weight of colors that frames show: a frame that shows them beside its outline counts, too
GUESSED = 0.01  # weight of other colors; mirror images seen at grazing angles have less


def mirror_texture(
    mesh: TexturedMesh, footage: Sequence[PosedSurface], plane: MirrorPlane
) -> tuple[Float[Tensor, "h w 3"], float]:
    """Color texels that no frame shows by the mirror image of the surface in the input view.

    Args:
        mesh: with the texture to change.
        footage: its surface at frames of the driving video, split along seams as the mesh.
        plane: mirror plane of the mesh.

    Returns:
        The texture, in [0, 1], equal on both sides of a seam; and the share of the surface's texels that have the color
        of a mirror image.
    """
    size = len(mesh.texture)
    covered = covered_texels(mesh.faces, mesh.uvs, size)
    normals = smooth_normals(mesh)
    texels = placed_texels(covered, mesh.vertices, normals)
    camera = OrbitCamera(width=size, height=size)
    color, alpha = render_mesh(mesh, [camera], supersampling=1)
    view = grade_pixels(color, alpha[..., 0], [camera], mesh.vertices, mesh.faces, OUTLINE)
    facing = interpolate(rasterize_mesh(mesh.vertices, mesh.faces, [camera]), mesh.faces, normals)
    images, nearness = _on_surface(_mirrored(texels, plane), camera, view[2][0], normalize(facing[0], dim=-1))
    mirrored = np.zeros((len(nearness), 4), np.float32)
    add_views(images, [camera], view, [(INPUT_MIN_COSINE, 1.0)], mirrored)
    weight = nearness * torch.from_numpy(mirrored[:, 3])
    found = (weight > 0).nonzero()[:, 0]
    shown = np.zeros((len(found), 4), np.float32)
    add_footage(footage, CoveredTexels(*(part[found] for part in covered)), mesh.faces, math.inf, 1.0, shown)
    share = plane.trust * weight[found] / (weight[found] + SHOWN * torch.from_numpy(shown[:, 3]) + GUESSED)
    colors = mesh.texture[texels.rows, texels.columns]
    taken = torch.from_numpy(mirrored[found, :3] / mirrored[found, 3:])
    colors[found] = torch.lerp(colors[found], taken, share[:, None])
    texture = level_seams(fill_texture(colors, texels, size), seam_points(mesh.vertices, mesh.faces, mesh.uvs, size))
    return texture, int((share > 0.5).sum()) / max(1, len(colors))


def _mirrored(texels: Texels, plane: MirrorPlane) -> Texels:
    return replace(texels, positions=plane.places(texels.positions), normals=plane.directions(texels.normals))


def _on_surface(
    texels: Texels, camera: OrbitCamera, depth: Float[Tensor, "h w"], normals: Float[Tensor, "h w 3"]
) -> tuple[Texels, Float[Tensor, " p"]]:
    """Return texels moved along the rays of a camera onto the surface that it sees, and how well they match it.

    Args:
        texels: near the surface, or not.
        camera: the camera.
        depth: camera z of the surface in every pixel, infinite where there is none.
        normals: of the surface in every pixel, unit vectors.

    Returns:
        The texels, and weights in [0, 1]: 1 where a texel lies on the surface and faces the same way.
    """
    view, eye = camera.viewmat().float(), camera.position().float()
    x, y, z = (texels.positions @ view[:3, :3].T + view[:3, 3]).T
    column = (camera.focal * x / z + camera.width / 2).long().clamp(0, camera.width - 1)
    row = (camera.focal * y / z + camera.height / 2).long().clamp(0, camera.height - 1)
    onto = depth[row, column]
    nearness = (1 - ((onto - z) / REACH).square()).clamp(min=0)
    cosine = (normals[row, column] * texels.normals).sum(-1)
    agreement = ((cosine - LEAST_AGREEMENT) / (1 - LEAST_AGREEMENT)).clamp(min=0)
    stretch = torch.where(nearness > 0, onto / z, 1.0)[:, None]
    return replace(texels, positions=eye + (texels.positions - eye) * stretch), nearness * agreement
