"""Step that sets a model of the user's own in motion, as the driving video shows it."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.assets.formats.foreign_glb import ForeignGlb, read_foreign_glb
from dg4d_lib.assets.formats.foreign_joints import read_skeleton
from dg4d_lib.assets.formats.foreign_motion import write_moving_glb
from dg4d_lib.deformation.framewise import Framewise
from dg4d_lib.fitting.asset_motion import fit_asset_motion, iterations
from dg4d_lib.fitting.asset_pose import Placement
from dg4d_lib.fitting.node_motion import NodeMotion
from dg4d_lib.fitting.rigid_parts import keep_pieces_rigid
from dg4d_lib.fitting.skeleton_motion import fit_skeleton_motion, skeleton_iterations
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.merging import merge_gaussians
from dg4d_lib.gaussians.ply import read_ply
from dg4d_lib.geometry.quaternion import quat_multiply, quat_to_rotmat
from dg4d_lib.mesh.models.atlas import merge_parts
from dg4d_lib.mesh.models.control_graph import ControlGraph, build_control_graph, graph_of_points, point_graph
from dg4d_lib.mesh.models.flips import unflip
from dg4d_lib.mesh.models.skeleton import JointGraph, joint_graph
from dg4d_lib.mesh.models.surface_cloud import SurfaceCloud, cover_surface
from dg4d_lib.mesh.neighbors import connected_parts, edge_graph
from dg4d_lib.mesh.textured import TrackedMesh
from dg4d_lib.rasterizer.interface import Rasterizer, get_rasterizer
from dg4d_lib.settings import FramewiseSettings
from steps.artifacts.media import read_frames, write_png
from steps.artifacts.meshes import write_tracked
from steps.artifacts.motions import write_motion
from steps.artifacts.placements import read_placement
from steps.fitting.reporting import LossCurves, picture_of_divergence, render_row
from steps.runtime.job import Job, StepReport

PICTURE_FRAMES = 6
NOTE = "The motion of sides that the video does not show follows from the rigidity of the surface."
RIGID_NOTE = "The model was animated as {} rigid part{}, which matches the video better than a surface that bends."
JOINT_NOTE = "The model is animated by its skeleton; rotations of limbs that the video does not show are guesses."


@dataclass(frozen=True)
class PlacedMesh:
    """Mesh of a model in the world.

    Attributes:
        glb: the model as given.
        placement: of it in the world.
        surface: covered with Gaussians, placed.
        graph: nodes that move the vertices of the surface.
        joints: the same, where they are joints of a skeleton.
    """

    glb: ForeignGlb
    placement: Placement
    surface: SurfaceCloud
    graph: ControlGraph
    joints: JointGraph | None


def run(job: Job) -> StepReport:
    """Fit the motion; write it for the Gaussians, and for a mesh also as morph targets of the model."""
    settings: AssetSettings = job.settings.asset
    rasterize = get_rasterizer(job.settings.rasterizer)
    cloud = read_ply(job.inputs["gaussians"])
    video = read_frames(job.inputs["driving_video"], job.pictures)
    mesh = None
    if "glb" in job.inputs:
        glb = read_foreign_glb(job.inputs["glb"].read_bytes(), settings.max_faces)
        placement = read_placement(job.inputs["placement"])
        # covered in its own coordinates, as in prepare_asset: rows of `nearest` are rows of the Gaussians
        covered = cover_surface(glb.model, settings.points, torch.Generator().manual_seed(job.seed))
        surface = covered.placed(placement.quat, placement.scale, placement.shift)
        mesh = attach_controls(glb, placement, surface, settings)
        graph = mesh.graph.of(surface.nearest)
        fitted, bound = cloud, graph
    else:
        points = cloud.means.double().numpy()
        graph = graph_of_points(points, point_graph(points), settings.nodes)
        fitted, bound = merged_graph(cloud, graph, settings.fit_points)
    joints = mesh.joints if mesh else None
    count = (iterations if joints is None else skeleton_iterations)(settings, len(video))
    curves, generator = LossCurves(count, job.progress), torch.Generator().manual_seed(job.seed)
    with picture_of_divergence(job, rasterize):
        if mesh and joints is not None:
            gaussians = joints.of(mesh.surface.nearest)
            motion = fit_skeleton_motion(cloud, gaussians, video, rasterize, settings, generator, curves.add)
        else:
            motion = fit_asset_motion(fitted, bound, video, rasterize, settings, generator, curves.add)
    if mesh and joints is None:
        mesh = replace(mesh, graph=moving_graph(mesh.graph, motion, settings.rigid_parts, mesh.surface.fine.faces))
        graph = mesh.graph.of(mesh.surface.nearest)
    states = moved_states(cloud, graph, motion)
    deformation = framewise(cloud, states)
    write_motion(job.outputs["motion"], deformation, FramewiseSettings(), len(video), len(cloud))
    note = motion_note(motion, settings.rigid_parts) if joints is None else JOINT_NOTE
    notes = [note, *(_write_mesh(job, mesh, motion, video.fps, note) if mesh else ())]
    curves.write(job.outputs["curves"], "motion of the model", notes)
    write_png(job.outputs["picture"], _picture(states, rasterize))
    return StepReport(backend=f"{job.settings.rasterizer} rasterizer", notes=tuple(notes))


def attach_controls(
    glb: ForeignGlb, placement: Placement, surface: SurfaceCloud, settings: AssetSettings
) -> PlacedMesh:
    """Return a mesh controlled by its joints if it was posed by them, else by control nodes on its surface."""
    skeleton = read_skeleton(glb) if placement.posed else None
    if skeleton is None:
        control = build_control_graph(surface.fine.vertices, surface.fine.faces, settings.nodes)
        return PlacedMesh(glb, placement, surface, control, None)
    joints = joint_graph(skeleton, surface, glb.model.faces, placement.matrix)
    return PlacedMesh(glb, placement, surface, joints.graph, joints)


def merged_graph(cloud: Gaussians, graph: ControlGraph, most: int) -> tuple[Gaussians, ControlGraph]:
    """Merge splats down to a number for the fit; return them with their graph, which is that of the nearest splats."""
    merged = merge_gaussians(cloud, most)
    nearest = cKDTree(cloud.means.numpy()).query(merged.means.numpy())[1]
    return merged, graph.of(torch.as_tensor(nearest, dtype=torch.long))


def motion_note(motion: NodeMotion, most_parts: int) -> str:
    """Return a note on how the motion of sides that the video does not show was inferred."""
    parts = int(motion.parts.max()) + 1
    return RIGID_NOTE.format(parts, "s" * (parts != 1)) if parts <= most_parts else NOTE


def moving_graph(
    graph: ControlGraph, motion: NodeMotion, most_parts: int, faces: Int[np.ndarray, "f 3"]
) -> ControlGraph:
    """Return the graph that skins a surface to a motion: pieces stay rigid if the motion has few rigid parts.

    Args:
        graph: of the vertices.
        motion: of its nodes.
        most_parts: that count as few.
        faces: of the welded surface.
    """
    parts, count = motion.parts, len(graph.indices)
    if int(parts.max()) >= most_parts:
        return graph
    pieces = connected_parts(edge_graph(faces, count), np.arange(count))
    return keep_pieces_rigid(graph, parts, torch.from_numpy(pieces).long())


def moved_states(cloud: Gaussians, graph: ControlGraph, motion: NodeMotion) -> Gaussians:
    """Return Gaussians that the nodes move, at every frame."""
    frames = len(motion.shifts)
    rest = cloud.quats.expand(frames, -1, -1)
    return Gaussians(
        motion.points(cloud.means, graph),
        cloud.log_scales.expand(frames, -1, -1).contiguous(),
        quat_multiply(motion.rotations(graph), rest),
        cloud.opacity_logits,
        cloud.harmonics,
    )


def framewise(cloud: Gaussians, states: Gaussians) -> Framewise:
    """Return the deformation that gives these states at the frames."""
    deformation = Framewise(len(states.means), len(cloud))
    turned = states.quats
    near = (turned[:-1] * turned[1:]).sum(-1, keepdim=True) < 0  # a quaternion and its negative are one rotation
    signs = torch.where(torch.cat([torch.zeros_like(near[:1]), near]).cumsum(0) % 2 == 1, -1.0, 1.0)
    table = torch.cat(
        [states.means - cloud.means, states.log_scales - cloud.log_scales, signs * turned - cloud.quats], -1
    )
    with torch.no_grad():
        deformation.table.copy_(table)
    return deformation.requires_grad_(False)


def moved_vertices(
    surface: SurfaceCloud, graph: ControlGraph, motion: NodeMotion
) -> tuple[Float[Tensor, "t v 3"], int]:
    """Return the vertices of the model at every frame, without flipped faces; and how many faces stay flipped."""
    rest = surface.fine.vertices
    points = torch.from_numpy(rest.astype(np.float32))
    moved = motion.points(points, graph).numpy()
    turns = quat_to_rotmat(motion.rotations(graph)).numpy()
    left, frames = 0, []
    for state, turn in zip(moved, turns, strict=True):
        repaired, flipped = unflip(rest, state.astype(np.float64), surface.fine.faces, turn.astype(np.float64))
        frames.append(repaired[surface.welded].astype(np.float32))
        left += flipped
    return torch.from_numpy(np.stack(frames)), left


def _write_mesh(job: Job, mesh: PlacedMesh, motion: NodeMotion, fps: float, note: str) -> list[str]:
    """Write the model with morph targets, and as a tracked mesh with one texture; return notes."""
    vertices, flipped = moved_vertices(mesh.surface, mesh.graph, motion)
    content, notes = write_moving_glb(
        mesh.glb,
        mesh.placement.matrix,
        vertices.numpy(),
        fps,
        {"notes": [note]},
        job.settings.interpolation.upper(),
        job.settings.moving_normals,
    )
    job.outputs["moving"].write_bytes(content)
    merged, sources = merge_parts(mesh.glb.model.placed(mesh.placement.matrix), job.settings.texture_size)
    write_tracked(job.outputs["tracked"], TrackedMesh(merged, vertices[:, sources] - merged.vertices))
    return [*notes, *([f"{flipped} faces are flipped, summed over all frames"] if flipped else [])]


def _picture(states: Gaussians, rasterize: Rasterizer) -> Float[Tensor, "h w 3"]:
    """Render some frames from the front and from the side."""
    frames = torch.linspace(0, len(states.means) - 1, min(PICTURE_FRAMES, len(states.means))).round().long()
    selected = states.states(frames)
    return torch.cat([render_row(selected, [azimuth] * len(frames), rasterize) for azimuth in (0.0, 90.0)])
