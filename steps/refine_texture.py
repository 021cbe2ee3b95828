"""Step that refines textures with diffusion models and keeps the geometry."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from dg4d_lib.diffusion.components import default_device
from dg4d_lib.diffusion.video_model import VideoModel
from dg4d_lib.errors import BadInput
from dg4d_lib.guidance.distillation import TimestepSchedule
from dg4d_lib.guidance.zero123 import Zero123
from dg4d_lib.images import over_white
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.refiner_settings import IdentitySettings, ImageToImageSettings, RefinerSettings, VideoToVideoSettings
from dg4d_lib.texture.refine import MeshClip, RefinedTextures, refine_textures
from dg4d_lib.texture.refiner import ImageToImage, Refiner, VideoToVideo, noise_levels
from dg4d_lib.video.driving import DrivingVideo
from steps.artifacts.media import read_frames, read_png
from steps.artifacts.meshes import read_meshes, read_tracked, write_meshes, write_tracked
from steps.fitting.priors import open_zero123
from steps.runtime.job import Job, StepReport
from steps.runtime.weights import open_weights


def run(job: Job) -> StepReport:
    """Refine the texture of the tracked mesh, or of every frame's mesh; the refiner sees all frames as one video.

    Video diffusion is conditioned on the subject, the input picture; image diffusion on the frame of the driving video.
    A flow skips this step if `refiner.kind` is `identity`.

    Raises:
        BadInput: meshes and driving video have different numbers of frames.
        BackendUnavailable: weights or libraries are not installed.
        FitDiverged: the loss is not finite.
    """
    report = StepReport()
    if "tracked" in job.inputs:
        tracked = read_tracked(job.inputs["tracked"])
        (textures,), report = _refine(job, [MeshClip(tracked.mesh, tracked.offsets)])
        mesh = replace(tracked.mesh, texture=textures.texture)
        write_tracked(job.outputs["tracked"], replace(tracked, mesh=mesh, textures=textures.frame_textures))
    if "meshes" in job.inputs:
        meshes = read_meshes(job.inputs["meshes"])
        refined, report = _refine(job, [MeshClip(mesh, torch.zeros(1, *mesh.vertices.shape)) for mesh in meshes])
        pairs = zip(meshes, refined, strict=True)
        textured = [replace(mesh, texture=textures.texture) for mesh, textures in pairs]
        write_meshes(job.outputs["meshes"], dict(enumerate(textured)))
    return report


def _refine(job: Job, clips: Sequence[MeshClip]) -> tuple[list[RefinedTextures], StepReport]:
    """Return the refined textures of consecutive clips, and the report."""
    kind: RefinerSettings = job.settings.refiner
    with TemporaryDirectory() as scratch:
        driving = read_frames(job.inputs["driving_video"], Path(scratch))
    device = default_device()
    driving = DrivingVideo(driving.frames.to(device), driving.alpha.to(device), driving.fps)
    pictures = driving.over(driving.frames.new_ones(3))
    refiner: Refiner
    match kind:
        case IdentitySettings():
            raise BadInput("refiner.kind = identity leaves textures as they are; leave refine_texture out")
        case VideoToVideoSettings():
            opened = open_weights(kind.model.weights)
            model = VideoModel.load(opened.folder, kind.model, device)
            picture = over_white(read_png(job.inputs["subject"])).to(device)
            refiner, run_notes = VideoToVideo(kind, model, picture), model.notes
            method = f"by video diffusion {_range(noise_levels(kind, 0.0))}"
            if kind.strength_end:
                method += f" (in the last iteration {_range(noise_levels(kind, 1.0))})"
        case ImageToImageSettings():
            opened = open_zero123("refiner.prior", kind.prior)
            loaded = Zero123.load(opened.folder, kind.prior, device)
            prior = loaded.conditioned_on(pictures, TimestepSchedule(1.0))
            refiner, run_notes = ImageToImage(kind, prior), prior.batches.notes
            method = "picture by picture, by image diffusion"
    generator = torch.Generator().manual_seed(job.seed)
    on_device = [MeshClip(_to_device(clip.mesh, device), clip.offsets.to(device)) for clip in clips]
    refined = refine_textures(on_device, driving, refiner, kind.texture, generator, job.progress)
    often = "every iteration" if kind.texture.refresh_every == 1 else f"every {kind.texture.refresh_every} iterations"
    notes = [f"Textures were refined {method}; {kind.texture.iterations} iterations, new targets {often}."]
    if any(textures.frame_textures is not None for textures in refined):
        notes.append("The texture changes from frame to frame: every frame adds colors of its own to the shared one.")
    report = StepReport(f"{device.type} (diffusers)", opened.digests, opened.licenses, tuple(notes), run_notes())
    return [
        RefinedTextures(each.texture.cpu(), None if each.frame_textures is None else each.frame_textures.cpu())
        for each in refined
    ], report


def _range(sigmas: Sequence[float]) -> str:
    """Return the first noise level and the number of steps."""
    return f"from sigma {sigmas[0]:.3f} on, {len(sigmas) - 1} steps"


def _to_device(mesh: TexturedMesh, device: torch.device) -> TexturedMesh:
    return TexturedMesh(mesh.vertices.to(device), mesh.faces.to(device), mesh.uvs.to(device), mesh.texture.to(device))
