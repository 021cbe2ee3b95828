"""From Gaussians and their motion to textured triangles: one mesh that moves, or a mesh per frame.

In the mode `auto` there is no mesh where one cannot follow the motion: the step says so, and meshes per frame are made
instead.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dg4d_lib.assets.animated import Asset4D
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.deformation.interface import Displacement
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.ply import read_ply
from dg4d_lib.images import color_over_white
from dg4d_lib.mesh.extraction.check import MeshFacts, checked, welded
from dg4d_lib.mesh.extraction.clean import clean
from dg4d_lib.mesh.extraction.density import density_field
from dg4d_lib.mesh.extraction.extract import best_level, surface, usable_level
from dg4d_lib.mesh.render import render_mesh
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh.texturing.bake import bake, vertex_normals
from dg4d_lib.mesh.texturing.unwrap import unwrap
from dg4d_lib.mesh.tracking.isosurface_projection import project_to_isosurface
from dg4d_lib.mesh.tracking.nonrigid_registration import FOLLOWS, register_nonrigid
from dg4d_lib.mesh.tracking.reference_frame import relative_to_frame, select_reference_frame
from dg4d_lib.mesh.tracking.skinning import skin_vertices
from dg4d_lib.rasterizer.interface import Rasterizer, choose_rasterizer
from dg4d_lib.settings import MeshSettings
from steps.artifacts.media import write_png
from steps.artifacts.meshes import write_meshes, write_tracked
from steps.artifacts.motions import read_motion
from steps.profiles import ExtractMeshSettings
from steps.runtime.job import Job, StepReport

PICTURE_CAMERAS = [OrbitCamera(0, azimuth, width=256, height=256) for azimuth in (0.0, 75.0, 180.0, 285.0)]
FPS_UNKNOWN = 1.0  # frames per second: motion has no clock; refine_texture, which sees the driving video, sets it


def run(job: Job) -> StepReport:
    """Extract; the level of the surface is the one that agrees best with the outlines of the Gaussians at rest.

    Raises:
        BadInput: frames that the motion does not have.
    """
    settings: ExtractMeshSettings = job.settings
    rasterize = choose_rasterizer(settings.rasterizer)
    gaussians = read_ply(job.inputs["gaussians"])
    deformation, frames = read_motion(job.inputs["motion"])
    with torch.no_grad():
        displacement = deformation.displace(gaussians.means, torch.linspace(0, 1, frames))
    states = displacement.apply(gaussians)
    one = settings.mesh.mode != "per_frame"
    frame, followed = select_reference_frame(states, displacement, rasterize, settings.mesh) if one else (0, 1.0)
    rest = states.at(frame)
    if settings.mesh.mode == "auto" and followed < FOLLOWS:
        write_png(job.outputs["picture"], _picture_of_splats(rest, rasterize))
        note = f"one mesh does not follow this motion ({followed:.1%} IoU on trial): every frame gets its own"
        return StepReport(backend=f"{settings.rasterizer} rasterizer", notes=(note,))
    level, agreement = best_level(density_field(rest, settings.mesh), rest, rasterize, settings.mesh.density_threshold)
    notes = [f"surface at density {level:.3g}; its outlines agree with the Gaussians' to {agreement:.1%} (IoU)"]

    if one:
        job.progress(1, 3, {})
        mesh, offsets, agreed = _tracked(states, displacement, frame, level, rasterize, settings.mesh)
        job.progress(2, 3, {})
        write_tracked(job.outputs["tracked"], Asset4D(mesh, offsets, FPS_UNKNOWN, rest=frame))
        picture = _picture(mesh)
        notes.append(f"one mesh for {frames} frames: {len(mesh.vertices)} vertices, {len(mesh.faces)} triangles")
        notes.append(f"at rest it is {_facts(mesh)}")
        notes.append(f"it is the surface of frame {frame}, which follows the motion best ({followed:.1%} IoU on trial)")
        notes.append(
            f"its outlines agree with the Gaussians' to {agreed.mean():.1%} (IoU), to {agreed.min():.1%} at worst"
        )
        if agreed.mean() < FOLLOWS:
            notes.append("one mesh follows this motion poorly: --set mesh.mode=per_frame gives a mesh per frame")
    else:
        end = settings.end_frame or frames
        if not settings.first_frame < end <= frames:
            raise BadInput(f"frames {settings.first_frame} to {end} were asked for; the motion has {frames}")
        meshes = {}
        for frame in range(settings.first_frame, end):
            meshes[frame] = textured(states.at(frame), level, rasterize, settings.mesh)
            job.progress(frame - settings.first_frame + 1, end - settings.first_frame, {})
        write_meshes(job.outputs["meshes"], meshes)
        notes += _soundness(meshes)
        picture = _picture(meshes[settings.first_frame])
    write_png(job.outputs["picture"], picture)
    return StepReport(backend=f"{settings.rasterizer} rasterizer, pymeshlab, xatlas", notes=tuple(notes))


def textured(gaussians: Gaussians, level: float, rasterize: Rasterizer, settings: MeshSettings) -> TexturedMesh:
    """The surface of one state of the cloud at a density, with its colors."""
    vertices, faces = _cleaned_surface(gaussians, level, settings)
    return _colored(vertices, faces, gaussians, rasterize, settings)[0]


def _tracked(
    states: Gaussians,
    displacement: Displacement,
    frame: int,
    level: float,
    rasterize: Rasterizer,
    settings: MeshSettings,
) -> tuple[TexturedMesh, Float[Tensor, "t v 3"], Float[Tensor, " t"]]:
    """The mesh of the cloud as it is at one frame, what to add to its vertices at every frame, and how well that does.

    The last is the agreement of outlines (`register_nonrigid`).
    """
    rest = states.at(frame)
    vertices, faces = _cleaned_surface(rest, level, settings)
    mesh, copied = _colored(vertices, faces, rest, rasterize, settings)
    carried = skin_vertices(vertices, rest, relative_to_frame(displacement, frame))
    snapped = project_to_isosurface(vertices, carried, faces, states, level, settings)
    offsets, agreed = register_nonrigid(vertices, snapped, faces, states, level, rasterize, settings)
    return mesh, offsets[:, copied], agreed


def _cleaned_surface(
    gaussians: Gaussians, level: float, settings: MeshSettings
) -> tuple[Float[Tensor, "v 3"], Int[Tensor, "f 3"]]:
    field = density_field(gaussians, settings)
    vertices, faces = clean(*surface(field, usable_level(field, level)), settings, field.unit)
    return torch.from_numpy(vertices), torch.from_numpy(faces)


def _colored(
    vertices: Float[Tensor, "v 3"],
    faces: Int[Tensor, "f 3"],
    gaussians: Gaussians,
    rasterize: Rasterizer,
    settings: MeshSettings,
) -> tuple[TexturedMesh, Int[Tensor, " w"]]:
    """Unwrapped and baked; and the old vertex of every new one."""
    copied, corners, uvs = (torch.from_numpy(a) for a in unwrap(vertices.numpy(), faces.numpy(), settings.texture_size))
    normals = vertex_normals(vertices, faces)[copied]
    texture = bake(vertices[copied], normals, corners, uvs, gaussians, rasterize, settings)
    return TexturedMesh(vertices[copied], corners, uvs, texture), copied


def _soundness(meshes: dict[int, TexturedMesh]) -> list[str]:
    facts = {frame: _facts(mesh) for frame, mesh in meshes.items()}
    flawed = [f"the mesh of frame {frame} is {its}" for frame, its in facts.items() if not its.sound]
    return [f"{len(facts) - len(flawed)} of {len(facts)} meshes from frame {min(facts)} on bound solids", *flawed]


def _facts(mesh: TexturedMesh) -> MeshFacts:
    return checked(*welded(mesh.vertices.numpy(), mesh.faces.numpy()))


def _picture(mesh: TexturedMesh) -> Float[Tensor, "h w 3"]:
    """Four views in a row, over white."""
    color, coverage = render_mesh(mesh, PICTURE_CAMERAS)
    return torch.cat(list(color_over_white(color, coverage)), 1)


def _picture_of_splats(gaussians: Gaussians, rasterize: Rasterizer) -> Float[Tensor, "h w 3"]:
    """The same views of a cloud."""
    white = torch.ones(3, device=gaussians.means.device)
    with torch.no_grad():
        return torch.cat(list(rasterize(gaussians, PICTURE_CAMERAS, white).color.clamp(0, 1)), 1)
