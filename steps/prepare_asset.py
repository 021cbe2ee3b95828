"""Step that reads a model of the user's own and finds its place in the frame of the subject."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.asset_settings import AssetSettings
from dg4d_lib.assets.formats.foreign_glb import ForeignGlb
from dg4d_lib.assets.formats.foreign_joints import read_skeleton
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.fitting.asset_pose import (
    SEARCHED,
    Placement,
    centered_placement,
    distinct_placements,
    find_placement,
    picture_of_both,
)
from dg4d_lib.fitting.skeleton_motion import PosedModel, pose_model
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.merging import merge_gaussians
from dg4d_lib.gaussians.ply import write_ply
from dg4d_lib.images import resize
from dg4d_lib.mesh.models.skeleton import joint_graph
from dg4d_lib.mesh.models.surface_cloud import SurfaceCloud, cover_surface
from dg4d_lib.rasterizer.interface import Rasterizer, get_rasterizer
from steps.artifacts.media import read_png, write_png
from steps.artifacts.placements import write_placement
from steps.fitting.reporting import render_turnaround
from steps.runtime.job import Job, StepReport
from steps.sources.models import OwnModel, read_model

POSED = 0.9  # IoU of the outlines of model and first frame below which the model is posed, not only placed
SUPERSAMPLE = 2  # of the render that becomes the subject: the rasterizer's low-pass filter widens small splats
POSE_NOTE = "The model rests in another pose than the first frame; its skeleton was posed to compare both."


def run(job: Job) -> StepReport:
    """Read the model, place it, and write it as Gaussians; without a subject, write its own render as the subject.

    Raises:
        BadInput: the model cannot be used, or does not agree with the subject; says why.
    """
    settings: AssetSettings = job.settings.asset
    rasterize = get_rasterizer(job.settings.rasterizer)
    with TemporaryDirectory() as scratch:
        own = read_model(job.inputs["model"], Path(scratch), settings, job.settings.max_decode_gb)
    job.progress(1, 3, {})
    surface = None if own.glb is None else cover(own.glb, settings, job.seed)
    cloud = own.splats if surface is None else surface.cloud
    assert cloud is not None  # a model is a mesh or splats
    azimuth = None if settings.find_azimuth else settings.azimuth_deg
    posed = None
    if "subject" in job.inputs:
        subject = read_png(job.inputs["subject"])
        searched = merge_gaussians(cloud, SEARCHED) if surface is None else cloud
        placement = find_placement(searched, subject, rasterize, azimuth, own.ups)
        if own.glb is not None and surface is not None:
            posed = posed_model(own.glb, surface, placement, subject, rasterize, settings, own.ups)
    else:
        placement = centered_placement(cloud, settings.azimuth_deg, own.ups[0])
        subject = render_subject(placement.apply(cloud), job.settings.size, rasterize)
        write_png(job.outputs["subject"], subject)
    both = picture_of_both(cloud, placement, subject, rasterize)
    if posed is not None:
        placement = posed.placement
        both = picture_of_both(posed.cloud, Placement.identity(), subject, rasterize)
    if "subject" in job.inputs and placement.agreement < settings.min_agreement:
        write_png(job.pictures / "model_and_subject.png", both)
        raise BadInput(_disagreement(placement, settings))
    job.progress(2, 3, {})
    if own.glb is not None:
        job.outputs["glb"].write_bytes(own.content)
    placed = placement.apply(cloud)
    write_ply(job.outputs["gaussians"], placed)
    write_placement(job.outputs["placement"], placement)
    write_png(job.outputs["picture"], _stacked(both, render_turnaround(placed, rasterize)))
    job.progress(3, 3, {})
    notes = (*_notes(own, placement, job), *([POSE_NOTE] if placement.posed else []), *own.notes)
    return StepReport(backend=f"{job.settings.rasterizer} rasterizer", notes=notes)


def render_subject(cloud: Gaussians, size: int, rasterize: Rasterizer) -> Float[Tensor, "s s 4"]:
    """Render a placed model from azimuth 0 as a cut-out, straight alpha."""
    camera = OrbitCamera(width=SUPERSAMPLE * size, height=SUPERSAMPLE * size)
    with torch.no_grad():
        rendering = rasterize(cloud, [camera], torch.zeros(3))
    color, alpha = (resize(image, (size, size))[0] for image in (rendering.color, rendering.alpha))
    return torch.cat([color / alpha.clamp_min(1e-4), alpha], -1).clamp(0, 1)


def cover(glb: ForeignGlb, settings: AssetSettings, seed: int) -> SurfaceCloud:
    """Return the surface of a model as Gaussians, in its own coordinates."""
    return cover_surface(glb.model, settings.points, torch.Generator().manual_seed(seed))


def posed_model(
    glb: ForeignGlb,
    surface: SurfaceCloud,
    at_rest: Placement,
    subject: Float[Tensor, "s s 4"],
    rasterize: Rasterizer,
    settings: AssetSettings,
    ups: Sequence[str],
) -> PosedModel | None:
    """Return the model in the pose of the first frame, at the azimuth that agrees best.

    None if it agrees in its rest pose, has no skeleton, or does not agree better in any pose.

    Args:
        glb: the model.
        surface: of it, in its own coordinates.
        at_rest: placement of the model in the pose that it rests in.
        subject: first frame, straight alpha.
        rasterize: rasterizer.
        settings: of the fit.
        ups: axes that may point up.
    """
    skeleton = read_skeleton(glb) if settings.skeleton and at_rest.agreement < POSED else None
    if skeleton is None:
        return None
    azimuth = None if settings.find_azimuth else settings.azimuth_deg
    found = []
    for placement in distinct_placements(surface.cloud, subject, rasterize, azimuth, ups):
        joints = joint_graph(skeleton, surface, glb.model.faces, placement.matrix).of(surface.nearest)
        found.append(pose_model(placement.apply(surface.cloud), joints, subject, placement, rasterize, settings))
    best = min(found, key=lambda one: one.difference)
    return best if best.placement.agreement > at_rest.agreement else None


def _disagreement(placement: Placement, settings: AssetSettings) -> str:
    return (
        f"the model does not agree with the first frame: their outlines overlap by {placement.agreement:.0%} (IoU) at "
        f"best, from azimuth {placement.azimuth_deg:.0f}; asset.min_agreement = {settings.min_agreement:g} is needed. "
        "Give the video of this very model, give the azimuth with --asset-azimuth, or lower the setting"
    )


def _notes(own: OwnModel, placement: Placement, job: Job) -> list[str]:
    if own.glb is not None:
        model = own.glb.model
        parts, vertices, faces = len(model.parts), len(model.vertices), len(model.faces)
        kind = f"{parts} mesh part{'s' * (parts != 1)}, {vertices} vertices, {faces} triangle{'s' * (faces != 1)}"
    else:
        assert own.splats is not None  # a model is a mesh or splats
        kind = f"{len(own.splats)} splat{'s' * (len(own.splats) != 1)}"
    notes = [f"the shape is a model of the user's own ({kind})"]
    if "subject" in job.inputs:
        notes.append(
            f"the first frame shows it from azimuth {placement.azimuth_deg:.0f} degrees; the outlines of both overlap "
            f"by {placement.agreement:.1%} (IoU)"
        )
    else:
        notes.append("the picture that is animated is a render of the model")
    return notes


def _stacked(first: Float[Tensor, "h w 3"], second: Float[Tensor, "i j 3"]) -> Float[Tensor, "k l 3"]:
    """Put two pictures above each other, on white."""
    width = max(first.shape[1], second.shape[1])
    rows = [torch.nn.functional.pad(one, (0, 0, 0, width - one.shape[1]), value=1.0) for one in (first, second)]
    return torch.cat(rows)
