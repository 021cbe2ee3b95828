"""Animated assets, and interpolation between their frames.

Animations loop: the last frame is followed by the first. A position is a fractional frame number in [0, frames]; from
the last frame to `frames` it interpolates back to the first frame.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from dg4d_lib.deformation.interface import Deformation
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.textured import TexturedMesh


@dataclass(frozen=True)
class Asset4D:
    """Tracked mesh with a frame rate.

    Attributes:
        mesh: the mesh at rest.
        offsets: added to the vertices at every frame, world units.
        fps: frames per second.
        extras: JSON that is written to the GLB unchanged.
        textures: colors of every frame in [0, 1]; None if all frames have the texture of `mesh`.
        reference_frame: position at which the offsets are 0, up to later corrections.
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
    """Evaluate the cloud at positions of an animation, one state each, without gradients.

    Between frames the deformation is evaluated directly; only from the last frame back to the first is it linear.

    Args:
        gaussians: the canonical cloud.
        deformation: its motion.
        frames: number of frames of the animation.
        positions: fractional frame numbers in [0, frames].
    """
    with torch.no_grad():
        times = positions.clamp(max=frames - 1) / max(1, frames - 1)
        states = deformation.displace(gaussians.means, times.to(gaussians.means)).apply(gaussians)
        weight = (positions - (frames - 1)).clamp(min=0.0).to(gaussians.means)[:, None, None]  # of the first frame
        if (weight > 0).any():
            first = deformation.displace(gaussians.means, gaussians.means.new_zeros(1)).apply(gaussians)
            states = _interpolate(states, first, weight)
        return states


def states_between(states: Gaussians, positions: Float[Tensor, " b"]) -> Gaussians:
    """Interpolate Gaussians that are given per frame."""
    before, after, share = _neighbors(positions, len(states.means))
    return _interpolate(states.states(before), states.states(after), share.to(states.means))


def _interpolate(states: Gaussians, others: Gaussians, share: Float[Tensor, "b 1 1"]) -> Gaussians:
    """Interpolate two states linearly; of q and -q, which are one rotation, take the nearer one."""
    opposite = (states.quats * others.quats).sum(-1, keepdim=True) < 0
    return replace(
        states,
        means=torch.lerp(states.means, others.means, share),
        log_scales=torch.lerp(states.log_scales, others.log_scales, share),
        quats=torch.lerp(states.quats, torch.where(opposite, -others.quats, others.quats), share),
    )


def interpolate_frames(values: Float[Tensor, "t n c"], positions: Float[Tensor, " m"]) -> Float[Tensor, "m n c"]:
    """Interpolate values per frame linearly, as players of a GLB do."""
    before, after, share = _neighbors(positions, len(values))
    return torch.lerp(values[before], values[after], share.to(values))


def _neighbors(
    positions: Float[Tensor, " m"], frames: int
) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"], Float[Tensor, "m 1 1"]]:
    """Return the frames before and after positions, and the share of the one after."""
    before = positions.floor().long()
    return before % frames, (before + 1) % frames, (positions - before)[:, None, None]
