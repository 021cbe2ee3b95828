"""Step that extracts textured meshes from moving Gaussians: one tracked mesh, or a mesh per frame."""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.deformation.interface import Displacement
from dg4d_lib.errors import BadInput
from dg4d_lib.fitting.guided_mesh import follow_video, refine_tracking, register_tracking
from dg4d_lib.fitting.tracking_order import is_loop
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.normals import vertex_normals
from dg4d_lib.guidance.interface import SubjectShapes
from dg4d_lib.images import color_over_white
from dg4d_lib.inflation.render import render_surface
from dg4d_lib.mesh.extraction.clean import clean
from dg4d_lib.mesh.extraction.density import density_field
from dg4d_lib.mesh.extraction.extract import extract_surface, usable_level
from dg4d_lib.mesh.extraction.silhouettes import render_silhouettes, silhouette_iou
from dg4d_lib.mesh.extraction.strands import Tube, with_strands
from dg4d_lib.mesh.extraction.topology import MeshTopology, check_topology, weld_vertices
from dg4d_lib.mesh.extraction.tunnels import fill_tunnels
from dg4d_lib.mesh.extraction.unfold import unfold
from dg4d_lib.mesh.fairing import fair
from dg4d_lib.mesh.render import render_mesh
from dg4d_lib.mesh.textured import TexturedMesh, TrackedMesh
from dg4d_lib.mesh.texturing.bake import Draw, gaussian_renderer
from dg4d_lib.mesh.texturing.chart_packing import QUICK
from dg4d_lib.mesh.texturing.footage import fit_texture
from dg4d_lib.mesh.tracking.color_registration import register_to_colors
from dg4d_lib.mesh.tracking.elastic import relax, turn_back
from dg4d_lib.mesh.tracking.isosurface_projection import project_to_isosurface
from dg4d_lib.mesh.tracking.moving_strands import find_strands_again, grow_moving_strands
from dg4d_lib.mesh.tracking.nonrigid_registration import MIN_IOU, register_nonrigid
from dg4d_lib.mesh.tracking.outline_detail import fit_outline_detail
from dg4d_lib.mesh.tracking.reference_frame import relative_to_frame
from dg4d_lib.mesh.tracking.separation import separate
from dg4d_lib.mesh.tracking.skinning import skin_vertices
from dg4d_lib.rasterizer.interface import Rasterizer, get_rasterizer
from dg4d_lib.settings import MeshSettings
from dg4d_lib.shape_prior import packaged
from dg4d_lib.video.driving import DrivingVideo
from steps.artifacts.media import read_frames, write_png
from steps.artifacts.mesh_plan import MeshPlan, read_plan, write_plan
from steps.artifacts.meshes import write_meshes, write_tracked
from steps.artifacts.motions import read_states
from steps.fitting.guesses import guessed_mirror, guessed_shapes
from steps.fitting.textures import (
    LEAST_ERROR,
    Frame,
    baked,
    colored,
    fitted,
    footage_of,
    frame_at,
    mirrored,
    shown_by,
    squared_error,
    squared_errors,
)
from steps.profiles import FrameRange
from steps.runtime.job import Job, StepReport

Surface = tuple[Float[Tensor, "v 3"], Int[Tensor, "f 3"]]
Textured = Callable[[TexturedMesh, Float[Tensor, "t v 3"]], TexturedMesh]  # gives a mesh its texture, by its positions

LOST_DB, LOST_SHARE = 8.0, 1 / 8  # loss of PSNR from which a frame counts as lost, and the largest share of such frames
CLOSE_ERROR = 1e-3  # squared error below which Gaussians are not closer to the video, 30 dB
FOLLOWED = {"gaussians": "motion", "video": "driving video"}
OUTLINES = {"gaussians": "the Gaussians'", "video": "those of video and Gaussians"}
PICTURE_CAMERAS = [OrbitCamera(0, azimuth, width=256, height=256) for azimuth in (0.0, 75.0, 180.0, 285.0)]


class RestShape(NamedTuple):
    """Surface that is tracked.

    Attributes:
        vertices: in the reference frame, world units, not split along seams.
        faces: counter-clockwise seen from outside.
        gaussians: in the reference frame.
        draw: renders the Gaussians or the shapes that the surface was extracted from.
    """

    vertices: Float[Tensor, "v 3"]
    faces: Int[Tensor, "f 3"]
    gaussians: Gaussians
    draw: Draw


class Candidate(NamedTuple):
    """Surface of one frame, tracked through the driving video.

    Attributes:
        frame: of the surface.
        rest: the surface.
        offsets: of its vertices at every frame.
    """

    frame: int
    rest: RestShape
    offsets: Float[Tensor, "t v 3"]


def run(job: Job) -> StepReport:
    """Extract the tracked mesh, or the meshes of frames `first_frame` to `end_frame`, according to the plan.

    In mode `auto`, a tracked mesh that loses the video is not written, but the plan of a mesh per frame is.

    Raises:
        BadInput: the motion does not have these frames.
    """
    plan = read_plan(job.inputs["plan"])
    given: MeshSettings = job.settings.mesh
    settings: MeshSettings = given.model_copy(update={"grid": plan.grid or given.grid})
    frames_of_task: FrameRange = job.settings
    rasterize = get_rasterizer(job.settings.rasterizer)
    states, displacement = read_states(job.inputs["gaussians"], job.inputs["motion"])
    frames, weights = len(states.means), {}
    video = _driving_video(job, frames)
    if plan.mode == "tracked":
        stages = 3 + len(plan.other_candidates)
        job.progress(1, stages, {})
        guesses = None
        if settings.source == "prior" and video and "subject" in job.inputs:
            hints = job.inputs.get("pose"), job.inputs.get("depth_field")
            guesses = guessed_shapes(video, *hints, job.settings.turn_deg)
            weights = packaged.digests()
        rest_shape = partial(_rest_shape, states, plan.level, rasterize, settings, guesses)
        if video and plan.guide == "video":
            tracked, ious, notes = _guided(job, rest_shape, states, video, plan, rasterize, settings)
        else:
            rest = rest_shape(plan.reference_frame)
            tracked, ious, notes = _tracked(rest, states, displacement, plan, rasterize, settings, video)
        job.progress(stages - 1, stages, {})
        mesh = tracked.mesh
        lost = _lost_frames(tracked, states, video, rasterize) if video and settings.mode == "auto" else 0
        if lost > LOST_SHARE * frames:
            write_plan(job.outputs["plan"], MeshPlan(mode="per_frame", level=plan.level, grid=plan.grid))
            note = f"one mesh is {LOST_DB:g} dB or more worse than the Gaussians in {lost} of {frames} frames"
            return _report(job, mesh, weights, [*notes, f"{note}; a mesh per frame is used"])
        if guesses is not None and video and settings.mirror_texture:
            plane = guessed_mirror(video, round(tracked.reference_frame))
            tracked, share = mirrored(tracked, video, plane)
            mesh = tracked.mesh
            notes = [
                *notes,
                f"far side: {share:.0%} of the texture is the mirror image of the near side",
            ]
        write_tracked(job.outputs["tracked"], tracked)
        kind = "isosurface of the Gaussians" if guesses is None else "shape network's surface"
        reference, agreement = tracked.reference_frame, f"{ious.mean():.1%} (IoU), {ious.min():.1%} at worst"
        notes = [
            f"one mesh for {frames} frames: {len(mesh.vertices):,} vertices, {len(mesh.faces):,} triangles",
            f"in the reference frame the mesh is {_check(mesh)}",
            f"the mesh is the {kind} of frame {reference:g}, which follows the {FOLLOWED[plan.guide]} best",
            *notes,
            f"the mesh's outlines agree with {OUTLINES[plan.guide]} to {agreement}",
        ]
        if ious.mean() < MIN_IOU:
            notes.append("one mesh follows this motion poorly: --set mesh.mode=per_frame gives a mesh per frame")
    else:
        first, end = frames_of_task.first_frame, frames_of_task.end_frame or frames
        if not first < end <= frames:
            raise BadInput(f"frames {first} to {end} were requested; the motion has {frames}")
        meshes = {}
        for frame in range(first, end):
            meshes[frame] = textured_mesh(states.at(frame), plan.level, rasterize, settings, frame_at(video, frame))
            job.progress(frame - first + 1, end - first, {})
        write_meshes(job.outputs["meshes"], meshes)
        notes = _soundness(meshes)
        mesh = meshes[first]
    return _report(job, mesh, weights, notes)


def _report(job: Job, mesh: TexturedMesh, weights: dict[str, str], notes: list[str]) -> StepReport:
    """Write the picture of a mesh; return the report of the step."""
    write_png(job.outputs["picture"], _picture(mesh))
    return StepReport(f"{job.settings.rasterizer} rasterizer, pymeshlab", weights, notes=tuple(notes))


def textured_mesh(
    gaussians: Gaussians, level: float, rasterize: Rasterizer, settings: MeshSettings, frame: Frame | None = None
) -> TexturedMesh:
    """Return the isosurface of one state of the Gaussians at a density, with a texture baked from it and the frame."""
    vertices, faces = _isosurface(gaussians, level, rasterize, settings)
    if frame is not None:
        alpha = frame[1][..., 0]
        vertices, faces = with_strands(vertices, faces, alpha)
        vertices = vertices + fit_outline_detail(vertices, torch.zeros_like(vertices)[None], faces, alpha[None])[0]
    shown = shown_by(vertices, faces, frame)
    mesh, sources = colored(vertices, faces, gaussian_renderer(gaussians, rasterize), settings, shown, QUICK)
    return replace(mesh, texture=fit_texture(mesh, shown(sources)))


def _driving_video(job: Job, frames: int) -> DrivingVideo | None:
    """Return the driving video, if the job has one."""
    if "driving_video" not in job.inputs:
        return None
    with TemporaryDirectory() as scratch:
        video = read_frames(job.inputs["driving_video"], Path(scratch))
    if len(video) != frames:
        raise BadInput(f"the driving video has {len(video)} frames and the motion {frames}; fit the motion again")
    return video


def _rest_shape(
    states: Gaussians,
    level: float,
    rasterize: Rasterizer,
    settings: MeshSettings,
    guesses: SubjectShapes | None,
    frame: int,
) -> RestShape:
    """Return the predicted surface of a frame, or without predictions the isosurface of the Gaussians."""
    gaussians = states.at(frame)
    if guesses is None:
        vertices, faces = _isosurface(gaussians, level, rasterize, settings)
        draw = gaussian_renderer(gaussians, rasterize)
    else:
        guess, unit = guesses.surface(frame), density_field(gaussians, settings).unit
        rough = clean(guess.vertices.double().numpy(), guess.faces.numpy(), settings, unit)
        vertices, faces = _faired(*rough, settings)
        draw = partial(render_surface, guess)
    return RestShape(vertices, faces, gaussians, draw)


def _tracked(
    rest: RestShape,
    states: Gaussians,
    displacement: Displacement,
    plan: MeshPlan,
    rasterize: Rasterizer,
    settings: MeshSettings,
    video: DrivingVideo | None,
) -> tuple[TrackedMesh, Float[Tensor, " t"], list[str]]:
    """Return the mesh of the reference frame with its offsets at every frame, the IoU of its outlines, and notes."""
    frame, level = plan.reference_frame, plan.level
    vertices, faces = rest.vertices, rest.faces
    with ThreadPoolExecutor(1) as beside:  # unwrapping keeps one core busy, and tracking needs no texture
        shown = shown_by(vertices, faces, frame_at(video, frame))
        coloring = beside.submit(colored, vertices, faces, rest.draw, settings, shown)
        skinned = skin_vertices(vertices, rest.gaussians, relative_to_frame(displacement, frame))
        projected = project_to_isosurface(vertices, skinned, faces, states, level, settings)
        silhouettes = render_silhouettes(states, range(len(projected)), rasterize)
        registered = register_nonrigid(vertices, projected, faces, states, silhouettes, level, settings)
        relaxed = relax(vertices, registered, faces, silhouettes)
        mesh, sources = coloring.result()
    strands: tuple[Tube, ...] = ()
    if video is not None:
        alpha = video.alpha[..., 0]
        vertices, relaxed, faces, strands = grow_moving_strands(vertices, relaxed, faces, alpha, frame)
        if strands:
            mesh, sources = colored(
                vertices, faces, rest.draw, settings, shown_by(vertices, faces, frame_at(video, frame))
            )
        textured = partial(fitted, faces=faces, sources=sources, video=video)
        mesh, relaxed = _registered(mesh, textured, sources, vertices, relaxed, faces, video)
    offsets, separated = _sound(vertices, relaxed, faces, silhouettes, video, strands)
    ious = silhouette_iou(vertices + offsets, faces, silhouettes)
    if video is not None:
        mesh = textured(mesh, vertices + offsets)
    notes = [_trial_note(plan), *_note(strands), *separated]
    return TrackedMesh(mesh, offsets[:, sources], reference_frame=frame), ious, notes


def _guided(
    job: Job,
    rest_shape: Callable[[int], RestShape],
    states: Gaussians,
    video: DrivingVideo,
    plan: MeshPlan,
    rasterize: Rasterizer,
    settings: MeshSettings,
) -> tuple[TrackedMesh, Float[Tensor, " t"], list[str]]:
    """Return the mesh that follows the driving video, with colors from it, the IoU of its outlines, and notes.

    Where the plan names several frames, the surface of each is tracked; the one that shows the video best stays.
    """
    level, candidates = plan.level, []
    for frame in (plan.reference_frame, *plan.other_candidates):
        rest, generator = rest_shape(frame), torch.Generator().manual_seed(job.seed)
        offsets = follow_video(rest.vertices, rest.faces, states, video, frame, rasterize, generator)
        candidates.append(Candidate(frame, rest, offsets))
        job.progress(1 + len(candidates), 3 + len(plan.other_candidates), {})
    notes = [_trial_note(plan)]
    best = candidates[0]
    if plan.other_candidates:
        scores = [_psnr(candidate, settings, video) for candidate in candidates]
        best = candidates[scores.index(max(scores))]
        listed = ", ".join(f"frame {one.frame} {score:.1f} dB" for one, score in zip(candidates, scores, strict=True))
        notes.append(f"PSNR at the input view after tracking, before registration: {listed}")
    vertices, faces, draw = best.rest.vertices, best.rest.faces, best.rest.draw
    offsets = register_tracking(
        vertices, best.offsets, faces, states, video, best.frame, level, rasterize, settings
    )  # fmt: skip
    alpha = video.alpha[..., 0]
    vertices, offsets, faces, strands = grow_moving_strands(vertices, offsets, faces, alpha, best.frame)
    mesh, sources = colored(
        vertices, faces, draw, settings, lambda sources: footage_of(vertices + offsets, faces, sources, video)
    )  # fmt: skip
    refined = refine_tracking(mesh, sources, vertices, offsets, faces, states, video, level, rasterize, settings)
    normals = vertex_normals(vertices, faces)[sources]
    textured = partial(
        baked, faces=faces, sources=sources, video=video, normals=normals, draw=draw, settings=settings
    )  # fmt: skip
    mesh, refined = _registered(mesh, textured, sources, vertices, refined, faces, video)
    silhouettes = render_silhouettes(states, range(len(refined)), rasterize, alpha)
    refined, separated = _sound(vertices, refined, faces, silhouettes, video, strands)
    moved = vertices + refined
    tracked = TrackedMesh(textured(mesh, moved), refined[:, sources], reference_frame=best.frame)
    return tracked, silhouette_iou(moved, faces, silhouettes), [*notes, *_note(strands), *separated]


def _trial_note(plan: MeshPlan) -> str:
    """Return a note with the IoU of the trial mesh by which the reference frame was selected."""
    return f"trial mesh of frame {plan.reference_frame}: {plan.followed:.1%} silhouette IoU over the motion"


def _note(strands: tuple[Tube, ...]) -> list[str]:
    """Return a note with the number of strands, if the mesh has any."""
    added = f"added thin parts (such as antennae) that are narrower than a cell of mesh.grid: {len(strands)}"
    return [added] if strands else []


def _psnr(candidate: Candidate, settings: MeshSettings, video: DrivingVideo) -> float:
    """Return the PSNR of the candidate's renders against the video, dB, with a texture from there."""
    moved, faces = candidate.rest.vertices + candidate.offsets, candidate.rest.faces
    mesh, sources = colored(
        candidate.rest.vertices,
        faces,
        candidate.rest.draw,
        settings,
        lambda sources: footage_of(moved, faces, sources, video),
        QUICK,
    )
    errors = squared_errors(mesh, footage_of(moved, faces, sources, video))
    return sum(-10 * math.log10(max(error, LEAST_ERROR)) for error in errors) / len(errors)


def _sound(
    vertices: Float[Tensor, "v 3"],
    offsets: Float[Tensor, "t v 3"],
    faces: Int[Tensor, "f 3"],
    silhouettes: Bool[Tensor, "t k h w"],
    video: DrivingVideo | None,
    strands: tuple[Tube, ...] = (),
) -> tuple[Float[Tensor, "t v 3"], list[str]]:
    """Return offsets with the video's outlines, fewer crossings and flipped faces, and a note if there were crossings.

    Faces may not be flipped against the reference frame, nor against the first frame, which is the base of the morph
    targets.
    """
    separated, frames = separate(vertices, offsets, faces, silhouettes, video is not None and is_loop(video))
    places = f"intersecting parts in {frames} of {len(offsets)} frames"
    notes = [f"{places} were separated, as far as the outlines allow"] if frames else []
    if video is not None and strands:
        separated = find_strands_again(vertices, separated, faces, strands, video.alpha[..., 0])
    turned = turn_back(vertices, separated, faces, silhouettes)
    first = turned[0]
    turned = turn_back(vertices + first, turned - first, faces, silhouettes) + first
    if video is not None:
        turned = fit_outline_detail(vertices, turned, faces, video.alpha[..., 0])
    return turned, notes


def _registered(
    mesh: TexturedMesh,
    textured: Textured,
    sources: Int[Tensor, " w"],
    vertices: Float[Tensor, "v 3"],
    offsets: Float[Tensor, "t v 3"],
    faces: Int[Tensor, "f 3"],
    video: DrivingVideo,
) -> tuple[TexturedMesh, Float[Tensor, "t v 3"]]:
    """Return the mesh with a texture from the video, and offsets that agree with the video's colors."""
    mesh, pictures = textured(mesh, vertices + offsets), video.over(video.frames.new_ones(3))
    return mesh, register_to_colors(mesh, sources, vertices, offsets, faces, pictures, sound=True)


def _lost_frames(tracked: TrackedMesh, states: Gaussians, video: DrivingVideo, rasterize: Rasterizer) -> int:
    """Count the frames where the mesh's PSNR is `LOST_DB` or more below that of the Gaussians, at the input view."""
    size = video.frames.shape[1]
    camera, white, lost = OrbitCamera(width=size, height=size), torch.ones(3), 0
    moved = tracked.mesh.vertices + tracked.offsets
    for frame, shown in enumerate(zip(video.frames, video.alpha, strict=True)):
        with torch.no_grad():
            color = rasterize(states.at(frame), [camera], white).color[0]
        best = max(float((color - color_over_white(*shown)).square().mean()), CLOSE_ERROR)
        lost += squared_error(tracked.mesh, moved[frame], shown) > best * 10 ** (LOST_DB / 10)
    return lost


def _isosurface(gaussians: Gaussians, level: float, rasterize: Rasterizer, settings: MeshSettings) -> Surface:
    field = density_field(gaussians, settings)
    level = usable_level(field, level)
    field = fill_tunnels(field, level, gaussians, rasterize)
    return _faired(*clean(*extract_surface(field, level), settings, field.unit), settings)


def _faired(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], settings: MeshSettings) -> Surface:
    vertices = unfold(fair(unfold(vertices, faces), faces, settings.fairing), faces)
    return torch.from_numpy(vertices), torch.from_numpy(faces)


def _soundness(meshes: dict[int, TexturedMesh]) -> list[str]:
    checks = {frame: _check(mesh) for frame, mesh in meshes.items()}
    flawed = [f"the mesh of frame {frame} is {check}" for frame, check in checks.items() if not check.valid]
    if len(checks) == 1:
        return flawed or [f"the mesh of frame {min(checks)} is a closed surface without defects"]
    sound = f"{len(checks) - len(flawed)} of {len(checks)}" if flawed else f"all {len(checks)}"
    return [f"{sound} meshes of frames {min(checks)} to {max(checks)} are closed surfaces without defects", *flawed]


def _check(mesh: TexturedMesh) -> MeshTopology:
    return check_topology(*weld_vertices(mesh.vertices.numpy(), mesh.faces.numpy()))


def _picture(mesh: TexturedMesh) -> Float[Tensor, "h w 3"]:
    """Render four views in a row, over white."""
    return torch.cat(list(color_over_white(*render_mesh(mesh, PICTURE_CAMERAS))), 1)
