"""Better textures by diffusion models; the geometry stays as it is."""

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
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.settings import IdentitySettings, ImageToImageSettings, RefinerSettings, VideoToVideoSettings
from dg4d_lib.texture.refine import MeshClip, RefinedTextures, refine_textures
from dg4d_lib.texture.refiner import ImageToImage, Refiner, VideoToVideo
from dg4d_lib.video.driving import DrivingVideo
from steps.artifacts.media import read_frames
from steps.artifacts.meshes import read_meshes, read_tracked, write_meshes, write_tracked
from steps.runtime.job import Job, StepReport
from steps.runtime.weights import open_weights


def run(job: Job) -> StepReport:
    """Refine the mesh that moves, or every frame's own; all frames are seen as one video.

    A flow leaves this step out where `refiner.kind` is `identity`.

    Raises:
        BadInput: meshes and driving video have different numbers of frames.
        BackendUnavailable: weights, or what loads them, are not here.
        FitDiverged: the loss left the finite numbers.
    """
    facts = StepReport()
    if "tracked" in job.inputs:
        tracked = read_tracked(job.inputs["tracked"])
        (its,), facts = _refined(job, [MeshClip(tracked.mesh, tracked.offsets)])
        mesh = replace(tracked.mesh, texture=its.texture)
        write_tracked(job.outputs["tracked"], replace(tracked, mesh=mesh, textures=its.frame_textures))
    if "meshes" in job.inputs:
        meshes = read_meshes(job.inputs["meshes"])
        refined, facts = _refined(job, [MeshClip(mesh, torch.zeros(1, *mesh.vertices.shape)) for mesh in meshes])
        better = [replace(mesh, texture=its.texture) for mesh, its in zip(meshes, refined, strict=True)]
        write_meshes(job.outputs["meshes"], dict(enumerate(better)))
    return facts


def _refined(job: Job, clips: Sequence[MeshClip]) -> tuple[list[RefinedTextures], StepReport]:
    """The textures of a motion, and how they were made."""
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
            refiner, halved = VideoToVideo(kind, model, pictures[0]), model.notes
            how = f"by video diffusion from sigma {refiner.sigmas[0]:.3f} on, {len(refiner.sigmas) - 1} steps"
        case ImageToImageSettings():
            opened = open_weights(kind.prior.weights)
            loaded = Zero123.load(opened.folder, kind.prior, device)
            prior = loaded.conditioned_on(pictures, TimestepSchedule(1.0))
            refiner, halved = ImageToImage(kind, prior), prior.batches.notes
            how = "picture by picture, by image diffusion"
    generator = torch.Generator().manual_seed(job.seed)
    there = [MeshClip(_on(device, clip.mesh), clip.offsets.to(device)) for clip in clips]
    refined = refine_textures(there, driving, refiner, kind.texture, generator, job.progress)
    often = "every iteration" if kind.texture.refresh_every == 1 else f"every {kind.texture.refresh_every} iterations"
    said = [f"Textures were refined {how}; {kind.texture.iterations} iterations, new targets {often}."]
    if any(its.frame_textures is not None for its in refined):
        said.append("The texture changes from frame to frame: every frame adds colors of its own to the shared one.")
    facts = StepReport(f"{device.type} (diffusers)", opened.digests, opened.licenses, tuple(said), halved())
    return [
        RefinedTextures(its.texture.cpu(), None if its.frame_textures is None else its.frame_textures.cpu())
        for its in refined
    ], facts


def _on(device: torch.device, mesh: TexturedMesh) -> TexturedMesh:
    return TexturedMesh(mesh.vertices.to(device), mesh.faces.to(device), mesh.uvs.to(device), mesh.texture.to(device))
