"""Textures of extracted meshes, from the frames of the video that show them."""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.geometry.normals import vertex_normals
from dg4d_lib.images import color_over_white
from dg4d_lib.mesh.render import render_mesh, smooth_normals, vertex_groups
from dg4d_lib.mesh.textured import TexturedMesh, TrackedMesh
from dg4d_lib.mesh.texturing.bake import Draw, PosedSurface, bake_texture
from dg4d_lib.mesh.texturing.chart_packing import THOROUGH, Effort
from dg4d_lib.mesh.texturing.footage import fit_texture
from dg4d_lib.mesh.texturing.mirrored import mirror_texture
from dg4d_lib.mesh.texturing.unwrap import unwrap
from dg4d_lib.mesh.tracking.reference_frame import evenly_spaced
from dg4d_lib.settings import MeshSettings
from dg4d_lib.shape_prior.mirror import MirrorPlane
from dg4d_lib.video.driving import DrivingVideo

Frame = tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 1"]]  # color and alpha
Footage = Callable[[Int[Tensor, " w"]], list[PosedSurface]]
COLORED = 16  # frames of the driving video that are baked into the texture of a mesh that follows it
SELECTIVITY = 2  # exponent of such a frame's weight in the inverse of its squared error
FITTED, FITTED_SELECTIVITY = 32, 1  # frames that the texture is then fitted to, and the exponent of their weights
LEAST_ERROR = 1e-4  # squared error below which frames weigh alike, 40 dB


def colored(
    vertices: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    draw: Draw,
    settings: MeshSettings,
    footage: Footage,
    effort: Effort = THOROUGH,
) -> tuple[TexturedMesh, Int[Tensor, " w"]]:
    """Return the unwrapped mesh with a baked texture, and the source vertex of each of its vertices."""
    unwrapped = unwrap(vertices.numpy(), faces.numpy(), settings.texture_size, settings.unwrap, effort)
    sources, corners, uvs = map(torch.from_numpy, unwrapped)
    normals = vertex_normals(vertices, faces)[sources]
    surfaces = footage(sources)
    texture = bake_texture(vertices[sources], normals, corners, uvs, draw, settings, surfaces)
    return TexturedMesh(vertices[sources], corners, uvs, texture), sources


def shown_by(vertices: Float[Tensor, "v 3"], faces: Int[Tensor, "f 3"], frame: Frame | None) -> Footage:
    """Return a function that splits a surface along seams, as a frame of the video shows it."""

    def split(sources: Int[Tensor, " w"]) -> list[PosedSurface]:
        if frame is None:
            return []
        return [PosedSurface(vertices[sources], vertex_normals(vertices, faces)[sources], *frame)]

    return split


def frame_at(video: DrivingVideo | None, frame: int) -> Frame | None:
    """Return color and alpha of a frame; None without a video."""
    return None if video is None else (video.frames[frame], video.alpha[frame])


def baked(
    mesh: TexturedMesh,
    moved: Float[Tensor, "t v 3"],
    faces: Int[Tensor, "f 3"],
    sources: Int[Tensor, " w"],
    video: DrivingVideo,
    normals: Float[Tensor, "w 3"],
    draw: Draw,
    settings: MeshSettings,
) -> TexturedMesh:
    """Return the mesh with a texture baked anew from the frames that it follows best, and fitted to the video."""
    footage = footage_of(moved, faces, sources, video, mesh)
    texture = bake_texture(mesh.vertices, normals, mesh.faces, mesh.uvs, draw, settings, footage)
    return fitted(replace(mesh, texture=texture), moved, faces, sources, video)


def fitted(
    mesh: TexturedMesh,
    moved: Float[Tensor, "t v 3"],
    faces: Int[Tensor, "f 3"],
    sources: Int[Tensor, " w"],
    video: DrivingVideo,
) -> TexturedMesh:
    """Return the mesh with its texture fitted to the video."""
    footage = footage_of(moved, faces, sources, video, mesh, FITTED, FITTED_SELECTIVITY)
    return replace(mesh, texture=fit_texture(mesh, footage))


def mirrored(tracked: TrackedMesh, video: DrivingVideo, plane: MirrorPlane) -> tuple[TrackedMesh, float]:
    """Return the mesh with colors of its near side where no frame shows its far side, and the share of such texels.

    Args:
        tracked: mesh that follows the video.
        video: of the camera at azimuth and elevation 0.
        plane: mirror plane of the subject at the reference frame.
    """

    def moved(frame: int) -> TexturedMesh:
        return replace(tracked.mesh, vertices=tracked.mesh.vertices + tracked.offsets[frame])

    footage, groups = [], vertex_groups(tracked.mesh)
    for frame in evenly_spaced(len(video), COLORED):
        posed = moved(frame)
        normals = smooth_normals(posed, groups)
        footage.append(PosedSurface(posed.vertices, normals, video.frames[frame], video.alpha[frame]))
    texture, share = mirror_texture(moved(round(tracked.reference_frame)), footage, plane)
    return replace(tracked, mesh=replace(tracked.mesh, texture=texture)), share


def footage_of(
    moved: Float[Tensor, "t v 3"],
    faces: Int[Tensor, "f 3"],
    sources: Int[Tensor, " w"],
    video: DrivingVideo,
    textured: TexturedMesh | None = None,
    count: int = COLORED,
    selectivity: float = SELECTIVITY,
) -> list[PosedSurface]:
    """Return some frames of the video with the surface, split along seams, that they show.

    With a textured mesh, frames weigh by how well its renders agree with them: badly tracked ones blur the texture.
    """
    frames = evenly_spaced(len(video), count)
    surfaces = [
        surface for frame in frames for surface in shown_by(moved[frame], faces, frame_at(video, frame))(sources)
    ]
    if textured is None:
        return surfaces
    errors = squared_errors(textured, surfaces)
    least = max(min(errors), LEAST_ERROR)
    weights = [(least / max(error, least)) ** selectivity for error in errors]
    return [replace(surface, weight=weight) for surface, weight in zip(surfaces, weights, strict=True)]


def squared_errors(mesh: TexturedMesh, surfaces: list[PosedSurface]) -> list[float]:
    """Return the mean squared errors of renders from the input camera against frames of the video, over white."""
    return [squared_error(mesh, surface.vertices, (surface.color, surface.alpha)) for surface in surfaces]


def squared_error(mesh: TexturedMesh, vertices: Float[Tensor, "v 3"], frame: Frame) -> float:
    """Return the mean squared error of the mesh with these vertices against a frame of the video, over white."""
    expected = color_over_white(*frame)
    camera = OrbitCamera(width=expected.shape[1], height=expected.shape[0])
    rendered = color_over_white(*render_mesh(replace(mesh, vertices=vertices), [camera]))[0]
    return float((rendered - expected).square().mean())
