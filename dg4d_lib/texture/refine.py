"""Textures follow better pictures of a moving mesh (paper section 3.4).

Every iteration looks at all frames twice: from the input view, where the driving video says how they look, and from a
camera that goes round at constant speed, where a refiner says it. Colors are optimized as logits, the shape stays.

A mesh that is tracked through many frames may get a texture per frame: what a frame adds to the shared texture is
optimized with it, as color and not as logit. Pictures are linear in colors, so the sum is read part by part, each with
its own number of texels, and no frame ever needs a texture of full size.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput, FitDiverged
from dg4d_lib.images import resize
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh.texturing.bake import vertex_normals
from dg4d_lib.mesh_rasterizer.texture import TextureLookup, build_lookup, sample_texture
from dg4d_lib.mesh_rasterizer.zbuffer import Fragments, rasterize_mesh
from dg4d_lib.mesh_rasterizer.zbuffer import interpolate as spread
from dg4d_lib.settings import TextureSettings
from dg4d_lib.texture.refiner import Refiner
from dg4d_lib.video.driving import DrivingVideo

DARKEST = 1 / 512  # colors are kept this far from 0 and 1, whose logits are infinite
STEEPEST = 1 / 4  # slope of a color over its logit, at most: colors learn at so much of the logits' rate


@dataclass(frozen=True)
class MeshClip:
    """Consecutive frames of one mesh with one texture: a tracked mesh is one stretch, a mesh per frame many.

    Attributes:
        mesh: at rest.
        offsets: added to its vertices in every frame, world units.
    """

    mesh: TexturedMesh
    offsets: Float[Tensor, "t v 3"]


@dataclass(frozen=True)
class RefinedTextures:
    """The colors of a stretch, in [0, 1].

    Attributes:
        texture: for all of its frames; texels that no picture shows are as they were.
        frames: for each of its frames, where they differ (`TextureSettings.frame_size`); smaller than `texture`.
    """

    texture: Float[Tensor, "h w 3"]
    frames: Float[Tensor, "t i j 3"] | None = None


def refine_textures(
    stretches: Sequence[MeshClip],
    driving: DrivingVideo,
    refiner: Refiner,
    settings: TextureSettings,
    generator: torch.Generator,
    progress: Callable[[int, int, dict[str, float]], None] = lambda done, total, values: None,
) -> list[RefinedTextures]:
    """The textures of every stretch after the refinement.

    Args:
        stretches: the whole motion, in the order of time.
        driving: what the input view sees, a frame per frame of the stretches; on their device.
        refiner: makes videos of the mesh better.
        settings: iterations, rate, sizes and the trajectory.
        generator: of the trajectories and of the refiner's noise, on the processor.
        progress: called with iterations done, their number, and the loss.

    Raises:
        BadInput: another number of frames than the driving video has.
        FitDiverged: the loss left the finite numbers.
    """
    frames = sum(len(stretch.offsets) for stretch in stretches)
    if frames != len(driving):
        raise BadInput(f"the mesh has {frames} frames and the driving video {len(driving)}; make them from one video")
    front = OrbitCamera(width=settings.size, height=settings.size)
    added = [_nothing_added(stretch, settings.frame_size) for stretch in stretches]
    reference, drawn = _look(stretches, added, [front] * frames)
    facing = _facing(stretches, drawn, [front] * frames, settings.min_cosine)
    del drawn  # as large as the pictures
    wanted = resize(driving.over(driving.frames.new_ones(3)), (settings.size, settings.size))
    textures = [stretch.mesh.texture for stretch in stretches]
    starts = [texture.clamp(DARKEST, 1 - DARKEST).logit() for texture in textures]
    logits = [start.clone().requires_grad_() for start in starts]
    own = [colors for colors in added if colors is not None]
    groups = [{"params": logits, "lr": settings.lr}, {"params": own, "lr": STEEPEST * settings.lr}]
    adam = torch.optim.Adam(groups if own else groups[:1])
    for iteration in range(settings.iterations):
        colors = [logit.sigmoid() for logit in logits]
        if iteration % settings.refresh_every == 0:
            cameras = _trajectory(frames, settings, generator)
            looks, _ = _look(stretches, added, cameras)
            seen = _draw(colors, added, looks)
            done = iteration / max(1, settings.iterations - 1)
            better = refiner.refine(seen.detach().clamp(0, 1), cameras, done, generator)
        else:
            seen = _draw(colors, added, looks)
        known = ((_draw(colors, added, reference) - wanted) * facing).square().mean((1, 2, 3)).sum()
        loss = known + (seen - better).square().mean() + settings.frame_weight * sum(map(_restlessness, own))
        value = loss.item()
        if not math.isfinite(value):
            raise FitDiverged(f"textures: the loss is {value} in iteration {iteration}; lower refiner.texture.lr")
        adam.zero_grad()
        loss.backward()
        adam.step()
        progress(iteration + 1, settings.iterations, {"loss": value})
    ends = zip(textures, starts, (logit.detach() for logit in logits), strict=True)
    shared = [torch.where(logit == start, texture, logit.sigmoid()) for texture, start, logit in ends]
    return [RefinedTextures(texture, _summed(texture, colors)) for texture, colors in zip(shared, added, strict=True)]


def _nothing_added(stretch: MeshClip, size: int) -> Float[Tensor, "t i j 3"] | None:
    """Where what every frame adds is kept: black, no larger than the texture; None where there is nothing to add."""
    frames, texture = len(stretch.offsets), stretch.mesh.texture
    if not size or frames == 1:
        return None
    shrunk = min(1.0, size / max(texture.shape[:2]))
    height, width = (max(1, round(side * shrunk)) for side in texture.shape[:2])
    return texture.new_zeros((frames, height, width, 3)).requires_grad_()


def _restlessness(added: Float[Tensor, "t i j 3"]) -> Float[Tensor, ""]:
    """How much frames add and how much that changes: mean squares, summed over frames as the pictures' errors are."""
    size, change = added.square(), added.diff(dim=0).square()
    return size.mean((1, 2, 3)).sum() + change.mean((1, 2, 3)).sum()


def _summed(texture: Float[Tensor, "h w 3"], added: Float[Tensor, "t i j 3"] | None) -> Float[Tensor, "t i j 3"] | None:
    """The texture of every frame."""
    if added is None:
        return None
    return (resize(texture[None], added.shape[1:3]) + added.detach()).clamp(0, 1)


def _trajectory(frames: int, settings: TextureSettings, generator: torch.Generator) -> list[OrbitCamera]:
    """A camera per frame on the horizon, at constant speed from a random start."""
    start = 360 * float(torch.rand((), generator=generator)) - 180
    return [
        OrbitCamera(azimuth_deg=start + frame * settings.azimuth_step_deg, width=settings.size, height=settings.size)
        for frame in range(frames)
    ]


@dataclass(frozen=True)
class _Look:
    """Where the pixels of a stretch look: into the shared texture, and frame by frame into what its frames add."""

    shared: TextureLookup
    own: tuple[TextureLookup, ...]


def _look(
    stretches: Sequence[MeshClip],
    added: Sequence[Float[Tensor, "_ _ _ 3"] | None],
    cameras: Sequence[OrbitCamera],
) -> tuple[list[_Look], list[Fragments]]:
    """Where the pixels of every frame look, and what was drawn for it."""
    looks, drawn, first = [], [], 0
    for stretch, colors in zip(stretches, added, strict=True):
        mesh, moved = stretch.mesh, stretch.mesh.vertices + stretch.offsets
        mine = cameras[first : first + len(moved)]
        first += len(moved)
        fragments = rasterize_mesh(moved, mesh.faces, mine)
        shared = build_lookup(moved, mesh.faces, mesh.uvs, mesh.texture.shape[:2], mine, fragments)
        own = (
            []
            if colors is None
            else [
                build_lookup(moved[i], mesh.faces, mesh.uvs, colors.shape[1:3], mine[i : i + 1], _of_view(fragments, i))
                for i in range(len(moved))
            ]
        )
        looks.append(_Look(shared, tuple(own)))
        drawn.append(fragments)
    return looks, drawn


def _facing(
    stretches: Sequence[MeshClip], drawn: Sequence[Fragments], cameras: Sequence[OrbitCamera], min_cosine: float
) -> Bool[Tensor, "t h w 1"]:
    """Which pixels of every frame see the surface at a better cosine."""
    places = torch.stack([camera.position() for camera in cameras])[:, None, None]
    facing = []
    for stretch, fragments in zip(stretches, drawn, strict=True):
        faces, moved = stretch.mesh.faces, stretch.mesh.vertices + stretch.offsets
        here, places = places[: len(moved)].to(moved), places[len(moved) :]
        normals = torch.stack([vertex_normals(state, faces) for state in moved])
        rays = normalize(here - spread(fragments, faces, moved), dim=-1)
        cosines = (rays * normalize(spread(fragments, faces, normals), dim=-1)).sum(-1, keepdim=True)
        facing.append((fragments.faces >= 0)[..., None] & (cosines > min_cosine))
    return torch.cat(facing)


def _of_view(fragments: Fragments, view: int) -> Fragments:
    return Fragments(*(getattr(fragments, field.name)[view : view + 1] for field in fields(fragments)))


def _draw(
    textures: Sequence[Float[Tensor, "_ _ 3"]],
    added: Sequence[Float[Tensor, "_ _ _ 3"] | None],
    looks: Sequence[_Look],
) -> Float[Tensor, "t h w 3"]:
    """All frames over white; differentiable in the textures and in what is added to them."""
    pictures = []
    for texture, colors, look in zip(textures, added, looks, strict=True):
        covered, seen = look.shared.covered, sample_texture(texture, look.shared)
        if colors is not None:
            seen = seen + torch.cat([sample_texture(frame, own) for frame, own in zip(colors, look.own, strict=True)])
        picture = texture.new_ones((*covered.shape, 3))
        picture[covered] = seen
        pictures.append(picture)
    return torch.cat(pictures)
