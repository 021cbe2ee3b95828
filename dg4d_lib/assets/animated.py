"""The finished product as a value: one topology, moved. And what "between two frames" means for it.

Animations are closed: after the last frame comes the first again. A position is a frame number that need not be whole;
it lies in [0, frames], and from the last frame to `frames` it leads back to the first.
"""

from dataclasses import dataclass, field
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.deformation.interface import Deformation, Displacement
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.textured import TexturedMesh


@dataclass(frozen=True)
class Asset4D:
    """A tracked mesh.

    Attributes:
        mesh: at rest.
        offsets: what to add to the vertices at every frame, world units.
        fps: frames per second.
        extras: JSON that goes into the GLB untouched.
        textures: the colors of every frame in [0, 1], where they change; None: always the mesh's own.
        reference_frame: the position at which the moved mesh is the mesh at rest, but for what was corrected afterwards.
    """

    mesh: TexturedMesh
    offsets: Float[Tensor, "t v 3"]
    fps: float
    extras: dict[str, Any] = field(default_factory=dict)
    textures: Float[Tensor, "t h w 3"] | None = None
    reference_frame: float = 0.0


def pose_gaussians(
    gaussians: Gaussians, deformation: Deformation, frames: int, positions: Float[Tensor, " m"]
) -> Gaussians:
    """The cloud at positions of an animation with this many frames, one state each, without gradients.

    Between frames the deformation itself says where things are; only the way back from the last frame is linear.
    """
    with torch.no_grad():
        times = positions.clamp(max=frames - 1) / max(1, frames - 1)
        there = deformation.displace(gaussians.means, times.to(gaussians.means))
        home = (positions - (frames - 1)).clamp(min=0.0).to(gaussians.means)[:, None, None]
        if (home > 0).any():
            start = deformation.displace(gaussians.means, gaussians.means.new_zeros(1))
            there = Displacement(
                torch.lerp(there.means, start.means, home),
                torch.lerp(there.log_scales, start.log_scales, home),
                torch.lerp(there.quats, start.quats, home),
            )
        return there.apply(gaussians)


def interpolate_frames(values: Float[Tensor, "t n c"], positions: Float[Tensor, " m"]) -> Float[Tensor, "m n c"]:
    """Values given per frame, linear between frames, as a player shows a GLB."""
    before = positions.floor().long()
    share = (positions - before).to(values)[:, None, None]
    return torch.lerp(values[before % len(values)], values[(before + 1) % len(values)], share)
