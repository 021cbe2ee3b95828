"""Texture optimization against refined renders of a moving mesh (paper section 3.4).

Every iteration renders all frames twice: from the input view, where the target is the driving video, and from a camera
that orbits at constant speed, where the target comes from a refiner. Colors are optimized as logits; the geometry is
fixed.

The loss on the orbit is a mean over all frames. Gradients of a texture that only one frame shows are thus inversely
proportional to the number of frames, and so small that Adam's epsilon shortens the steps. Its epsilon is scaled alike,
so that the steps are those of DG4D's public code, 14 frames with torch's default epsilon, for any number of frames.

A tracked mesh may also get a residual texture per frame, which is added to the shared texture and optimized as color,
not as logit. Rendering is linear in the colors, so both are sampled separately at their own resolutions and no frame
needs a texture of full size.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from dg4d_lib.adam import Adam
from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput, FitDiverged
from dg4d_lib.geometry.normals import vertex_normals
from dg4d_lib.images import resize
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh_rasterizer.texture import TextureLookup, build_lookup, sample_texture
from dg4d_lib.mesh_rasterizer.zbuffer import Fragments, interpolate, rasterize_mesh
from dg4d_lib.refiner_settings import TextureSettings
from dg4d_lib.texture.refiner import Refiner
from dg4d_lib.video.driving import DrivingVideo

MARGIN = 1 / 512  # distance of colors from 0 and 1, whose logits are infinite
ADAM_EPS, PUBLIC_FRAMES = 1e-8, 14  # torch's default epsilon, frames of DG4D's public code
MAX_SLOPE = 1 / 4  # maximum derivative of the sigmoid; ratio of the residuals' learning rate to that of the logits


@dataclass(frozen=True)
class MeshClip:
    """Consecutive frames of one mesh with one texture; a tracked mesh is one clip, a mesh per frame many.

    Attributes:
        mesh: the mesh at rest.
        offsets: added to its vertices at every frame, world units.
    """

    mesh: TexturedMesh
    offsets: Float[Tensor, "t v 3"]


@dataclass(frozen=True)
class RefinedTextures:
    """Refined textures of a clip, in [0, 1].

    Attributes:
        texture: shared by all frames; texels that no render shows keep their values.
        frame_textures: one per frame if `TextureSettings.frame_size` is set, smaller than `texture`.
    """

    texture: Float[Tensor, "h w 3"]
    frame_textures: Float[Tensor, "t i j 3"] | None = None


def refine_textures(
    clips: Sequence[MeshClip],
    driving: DrivingVideo,
    refiner: Refiner,
    settings: TextureSettings,
    generator: torch.Generator,
    progress: Callable[[int, int, dict[str, float]], None] = lambda done, total, values: None,
) -> list[RefinedTextures]:
    """Refine the textures of all clips.

    Args:
        clips: the whole motion in temporal order.
        driving: target of the input view, one frame per frame of the clips; on their device.
        refiner: improves renders of the mesh.
        settings: iterations, learning rate, sizes and trajectory.
        generator: random numbers for the trajectories and the refiner's noise, on the CPU.
        progress: called with finished iterations, all iterations, and the loss.

    Raises:
        BadInput: the clips and the driving video have different numbers of frames.
        FitDiverged: the loss became NaN or infinite.
    """
    frames = sum(len(clip.offsets) for clip in clips)
    if frames != len(driving):
        raise BadInput(
            f"the mesh has {frames} frames and the driving video has {len(driving)}; extract the mesh again from a "
            "motion that was fitted to this video"
        )
    front = OrbitCamera(width=settings.size, height=settings.size)
    residuals = [_new_residual(clip, settings.frame_size) for clip in clips]
    reference, fragments = _build_lookups(clips, residuals, [front] * frames)
    facing = _facing(clips, fragments, [front] * frames, settings.min_cosine)
    del fragments  # as large as the renders
    ground_truth = resize(driving.over(driving.frames.new_ones(3)), (settings.size, settings.size))
    textures = [clip.mesh.texture for clip in clips]
    starts = [texture.clamp(MARGIN, 1 - MARGIN).logit() for texture in textures]
    logits = [start.clone().requires_grad_() for start in starts]
    trained = [residual for residual in residuals if residual is not None]
    frame_eps = ADAM_EPS * PUBLIC_FRAMES / frames
    shared_eps = ADAM_EPS if len(clips) == 1 else frame_eps  # all frames show the texture of a single clip
    groups = [
        {"params": logits, "lr": settings.lr, "eps": shared_eps},
        {"params": trained, "lr": MAX_SLOPE * settings.lr, "eps": frame_eps},
    ]
    adam = Adam(groups)
    for iteration in range(settings.iterations):
        colors = [logit.sigmoid() for logit in logits]
        if iteration % settings.refresh_every == 0:
            cameras = _trajectory(frames, settings, generator)
            lookups, _ = _build_lookups(clips, residuals, cameras)
            renders = _render(colors, residuals, lookups)
            done = iteration / max(1, settings.iterations - 1)
            refined = refiner.refine(renders.detach().clamp(0, 1), cameras, done, generator)
        else:
            renders = _render(colors, residuals, lookups)
        reference_loss = (
            ((_render(colors, residuals, reference) - ground_truth) * facing).square().mean((1, 2, 3)).sum()
        )
        regularization = settings.frame_weight * sum(map(_regularization_loss, trained))
        loss = reference_loss + (renders - refined).square().mean() + regularization
        value = loss.item()
        if not math.isfinite(value):
            raise FitDiverged(
                f"texture refinement: the loss is {value} in iteration {iteration}; lower refiner.texture.lr"
            )
        adam.zero_grad()
        loss.backward()
        adam.step()
        progress(iteration + 1, settings.iterations, {"loss": value})
    ends = zip(textures, starts, (logit.detach() for logit in logits), strict=True)
    shared = [torch.where(logit == start, texture, logit.sigmoid()) for texture, start, logit in ends]
    return [
        RefinedTextures(texture, _frame_textures(texture, residual))
        for texture, residual in zip(shared, residuals, strict=True)
    ]


def _new_residual(clip: MeshClip, size: int) -> Float[Tensor, "t i j 3"] | None:
    """Allocate residual textures of zeros, no larger than the texture; None for a single frame or `size` 0."""
    frames, texture = len(clip.offsets), clip.mesh.texture
    if not size or frames == 1:
        return None
    scale = min(1.0, size / max(texture.shape[:2]))
    height, width = (max(1, round(side * scale)) for side in texture.shape[:2])
    return texture.new_zeros((frames, height, width, 3)).requires_grad_()


def _regularization_loss(residual: Float[Tensor, "t i j 3"]) -> Float[Tensor, ""]:
    """Return mean squares of the residuals and of their change over time, summed over frames."""
    size, change = residual.square(), residual.diff(dim=0).square()
    return size.mean((1, 2, 3)).sum() + change.mean((1, 2, 3)).sum()


def _frame_textures(
    texture: Float[Tensor, "h w 3"], residual: Float[Tensor, "t i j 3"] | None
) -> Float[Tensor, "t i j 3"] | None:
    """Add the residuals to the shared texture."""
    if residual is None:
        return None
    return (resize(texture[None], residual.shape[1:3]) + residual.detach()).clamp(0, 1)


def _trajectory(frames: int, settings: TextureSettings, generator: torch.Generator) -> list[OrbitCamera]:
    """Return a camera per frame on the horizon, orbiting at constant speed from a random azimuth."""
    start = 360 * float(torch.rand((), generator=generator)) - 180
    return [
        OrbitCamera(azimuth_deg=start + frame * settings.azimuth_step_deg, width=settings.size, height=settings.size)
        for frame in range(frames)
    ]


@dataclass(frozen=True)
class _ClipLookup:
    """Texture lookups of a clip: into the shared texture, and into the residual of every frame."""

    shared: TextureLookup
    residuals: tuple[TextureLookup, ...]


def _build_lookups(
    clips: Sequence[MeshClip],
    residuals: Sequence[Float[Tensor, "_ _ _ 3"] | None],
    cameras: Sequence[OrbitCamera],
) -> tuple[list[_ClipLookup], list[Fragments]]:
    """Rasterize all clips, one camera per frame; return their texture lookups and fragments."""
    lookups, all_fragments, first = [], [], 0
    for clip, residual in zip(clips, residuals, strict=True):
        mesh, moved = clip.mesh, clip.mesh.vertices + clip.offsets
        views = cameras[first : first + len(moved)]
        first += len(moved)
        fragments = rasterize_mesh(moved, mesh.faces, views)
        shared = build_lookup(moved, mesh.faces, mesh.uvs, mesh.texture.shape[:2], views, fragments)
        per_frame = []
        if residual is not None:
            for i, view in enumerate(views):
                fragment, size = _view_of(fragments, i), residual.shape[1:3]
                per_frame.append(build_lookup(moved[i], mesh.faces, mesh.uvs, size, [view], fragment))
        lookups.append(_ClipLookup(shared, tuple(per_frame)))
        all_fragments.append(fragments)
    return lookups, all_fragments


def _facing(
    clips: Sequence[MeshClip], all_fragments: Sequence[Fragments], cameras: Sequence[OrbitCamera], min_cosine: float
) -> Bool[Tensor, "t h w 1"]:
    """Mark the pixels of every frame that show the surface at more than the minimum cosine."""
    camera_centers = torch.stack([camera.position() for camera in cameras])[:, None, None]
    facing = []
    for clip, fragments in zip(clips, all_fragments, strict=True):
        faces, moved = clip.mesh.faces, clip.mesh.vertices + clip.offsets
        centers, camera_centers = camera_centers[: len(moved)].to(moved), camera_centers[len(moved) :]
        normals = torch.stack([vertex_normals(state, faces) for state in moved])
        rays = normalize(centers - interpolate(fragments, faces, moved), dim=-1)
        cosines = (rays * normalize(interpolate(fragments, faces, normals), dim=-1)).sum(-1, keepdim=True)
        facing.append((fragments.faces >= 0)[..., None] & (cosines > min_cosine))
    return torch.cat(facing)


def _view_of(fragments: Fragments, view: int) -> Fragments:
    return Fragments(*(getattr(fragments, field.name)[view : view + 1] for field in fields(fragments)))


def _render(
    textures: Sequence[Float[Tensor, "_ _ 3"]],
    residuals: Sequence[Float[Tensor, "_ _ _ 3"] | None],
    lookups: Sequence[_ClipLookup],
) -> Float[Tensor, "t h w 3"]:
    """Render all frames over white; differentiable in the textures and residuals."""
    renders = []
    for texture, residual, lookup in zip(textures, residuals, lookups, strict=True):
        covered, colors = lookup.shared.covered, sample_texture(texture, lookup.shared)
        if residual is not None:
            frames = zip(residual, lookup.residuals, strict=True)
            colors = colors + torch.cat([sample_texture(frame, own) for frame, own in frames])
        render = texture.new_ones((*covered.shape, 3))
        render[covered] = colors
        renders.append(render)
    return torch.cat(renders)
