"""Textures follow better pictures of a moving mesh (paper section 3.4).

Every iteration looks at all frames twice: from the input view, where the driving video says how they look, and from a
camera that goes round at constant speed, where a refiner says it. Colors are optimized as logits, the shape stays.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput, FitDiverged
from dg4d_lib.mesh.bake import vertex_normals
from dg4d_lib.mesh.textured import TexturedMesh
from dg4d_lib.mesh_rasterizer.texture import Lookup, look_up, read
from dg4d_lib.mesh_rasterizer.zbuffer import interpolate as spread
from dg4d_lib.mesh_rasterizer.zbuffer import rasterize_mesh
from dg4d_lib.settings import TextureSettings
from dg4d_lib.texture.refiner import Refiner
from dg4d_lib.video.driving import DrivingVideo

DARKEST = 1 / 512  # colors are kept this far from 0 and 1, whose logits are infinite


@dataclass(frozen=True)
class Stretch:
    """Consecutive frames of one mesh with one texture: a tracked mesh is one stretch, a mesh per frame many.

    Attributes:
        mesh: at rest.
        offsets: added to its vertices in every frame, world units.
    """

    mesh: TexturedMesh
    offsets: Float[Tensor, "t v 3"]


def refine_textures(
    stretches: Sequence[Stretch],
    driving: DrivingVideo,
    refiner: Refiner,
    settings: TextureSettings,
    generator: torch.Generator,
    progress: Callable[[int, int, dict[str, float]], None] = lambda done, total, values: None,
) -> list[Float[Tensor, "h w 3"]]:
    """The texture of every stretch after the refinement.

    Args:
        stretches: the whole motion, in the order of time.
        driving: what the input view sees, a frame per frame of the stretches; on their device.
        refiner: makes videos of the mesh better.
        settings: iterations, rate, sizes and the trajectory.
        generator: of the trajectories and of the refiner's noise, on the processor.
        progress: called with iterations done, their number, and the loss.

    Returns:
        Colors in [0, 1]; texels that no picture shows keep theirs.

    Raises:
        BadInput: another number of frames than the driving video has.
        FitDiverged: the loss left the finite numbers.
    """
    frames = sum(len(stretch.offsets) for stretch in stretches)
    if frames != len(driving):
        raise BadInput(f"the mesh has {frames} frames and the driving video {len(driving)}; make them from one video")
    front = OrbitCamera(width=settings.size, height=settings.size)
    reference, facing = _look(stretches, [front] * frames, settings.min_cosine)
    wanted = _resized(driving.over(driving.frames.new_ones(3)), settings.size)
    textures = [stretch.mesh.texture for stretch in stretches]
    starts = [texture.clamp(DARKEST, 1 - DARKEST).logit() for texture in textures]
    logits = [start.clone().requires_grad_() for start in starts]
    adam = torch.optim.Adam(logits, lr=settings.rate)
    for iteration in range(settings.iterations):
        colors = [logit.sigmoid() for logit in logits]
        if iteration % settings.refresh_every == 0:
            cameras = _trajectory(frames, settings, generator)
            lookups, _ = _look(stretches, cameras)
            seen = _draw(colors, lookups)
            done = iteration / max(1, settings.iterations - 1)
            better = refiner.refine(seen.detach(), cameras, done, generator)
        else:
            seen = _draw(colors, lookups)
        known = ((_draw(colors, reference) - wanted) * facing).square().mean((1, 2, 3)).sum()
        loss = known + (seen - better).square().mean()
        value = loss.item()
        if not math.isfinite(value):
            raise FitDiverged(f"textures: the loss is {value} in iteration {iteration}; lower refiner.texture.rate")
        adam.zero_grad()
        loss.backward()
        adam.step()
        progress(iteration + 1, settings.iterations, {"loss": value})
    ends = zip(textures, starts, (logit.detach() for logit in logits), strict=True)
    return [torch.where(logit == start, texture, logit.sigmoid()) for texture, start, logit in ends]


def _trajectory(frames: int, settings: TextureSettings, generator: torch.Generator) -> list[OrbitCamera]:
    """A camera per frame on the horizon, at constant speed from a random start."""
    start = 360 * float(torch.rand((), generator=generator)) - 180
    return [
        OrbitCamera(azimuth_deg=start + frame * settings.azimuth_step_deg, width=settings.size, height=settings.size)
        for frame in range(frames)
    ]


def _look(
    stretches: Sequence[Stretch], cameras: Sequence[OrbitCamera], min_cosine: float = -1.0
) -> tuple[list[Lookup], Bool[Tensor, "t h w 1"]]:
    """Where the pixels of every frame look into its texture, and which see the surface at a better cosine."""
    lookups, facing, first = [], [], 0
    for stretch in stretches:
        mesh, moved = stretch.mesh, stretch.mesh.vertices + stretch.offsets
        mine = cameras[first : first + len(moved)]
        first += len(moved)
        fragments = rasterize_mesh(moved, mesh.faces, mine)
        lookups.append(look_up(moved, mesh.faces, mesh.uvs, mesh.texture.shape[:2], mine, fragments))
        normals = torch.stack([vertex_normals(state, mesh.faces) for state in moved])
        places = torch.stack([camera.position().to(moved) for camera in mine])[:, None, None]
        rays = normalize(places - spread(fragments, mesh.faces, moved), dim=-1)
        cosines = (rays * normalize(spread(fragments, mesh.faces, normals), dim=-1)).sum(-1, keepdim=True)
        facing.append((fragments.faces >= 0)[..., None] & (cosines > min_cosine))
    return lookups, torch.cat(facing)


def _draw(textures: Sequence[Float[Tensor, "i j 3"]], lookups: Sequence[Lookup]) -> Float[Tensor, "t h w 3"]:
    """All frames over white; differentiable in the textures."""
    pictures = []
    for texture, lookup in zip(textures, lookups, strict=True):
        picture = texture.new_ones((*lookup.covered.shape, 3))
        picture[lookup.covered] = read(texture, lookup)
        pictures.append(picture)
    return torch.cat(pictures)


def _resized(pictures: Float[Tensor, "t h w 3"], size: int) -> Float[Tensor, "t s s 3"]:
    planes = pictures.movedim(-1, 1)
    return interpolate(planes, (size, size), mode="bilinear", antialias=True, align_corners=False).movedim(1, -1)
