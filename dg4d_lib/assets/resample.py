"""Resampling of animations to other frame rates; the motion is a continuous function of time."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.assets.animated import Asset4D, interpolate_frames, pose_gaussians
from dg4d_lib.deformation.interface import Deformation, Displacement
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.tracking.skinning import skin_vertices

MIN_STATES = 4  # fewer can miss both ends of a swing: two states of a sine that starts at 0 are equal
MAX_STATES = 1000  # a GLB has a morph target per state, and weights of all of them at every key
STATES_AT_ONCE = 32  # bounds memory


def nearest_rate(frames: int, fps: float, wanted: float) -> float:
    """Return the frame rate nearest to the wanted one that `resampled_positions` accepts for these frames."""
    least, most = _state_limits(frames)
    return min(max(wanted, least / frames * fps), most / frames * fps)  # exactly fps for all frames


def resampled_positions(frames: int, fps: float, wanted: float) -> Float[Tensor, " m"]:
    """Return the positions of round(frames * wanted / fps) states of a loop at another frame rate.

    They divide the loop evenly, starting at the first frame. The duration of the loop changes by half a state at most.

    Args:
        frames: number of frames of the animation.
        fps: its frames per second.
        wanted: states per second of the result.

    Returns:
        Fractional frame numbers in [0, frames); float64, so that whole frames are exact.

    Raises:
        BadInput: the result would have fewer states than 4 and than frames, or more than 1,000 and than frames.
    """
    count, (least, most) = round(frames * wanted / fps), _state_limits(frames)
    if not least <= count <= most:
        raise BadInput(
            f"{wanted:g} frames per second give {count} states for this motion of {frames / fps:.3g} s, {least} to "
            f"{most} are allowed; set pack.fps to {nearest_rate(frames, fps, wanted):.4g}"
        )
    return torch.arange(count, dtype=torch.float64) * frames / count


def _state_limits(frames: int) -> tuple[int, int]:
    return min(MIN_STATES, frames), max(MAX_STATES, frames)


def pose_gaussians_in_chunks(
    gaussians: Gaussians, deformation: Deformation, frames: int, positions: Float[Tensor, " m"]
) -> Gaussians:
    """Call `pose_gaussians` on a few positions at a time, since deformation networks need much memory per position."""
    parts = [pose_gaussians(gaussians, deformation, frames, part) for part in positions.split(STATES_AT_ONCE)]
    return replace(
        gaussians,
        means=torch.cat([part.means for part in parts]),
        log_scales=torch.cat([part.log_scales for part in parts]),
        quats=torch.cat([part.quats for part in parts]),
    )


def resample_asset(asset: Asset4D, gaussians: Gaussians, deformation: Deformation, frames: int, fps: float) -> Asset4D:
    """Resample a tracked mesh to another frame rate.

    Between frames the vertices are skinned to the Gaussians, as at the frames; the corrections that followed skinning
    at the frames are interpolated linearly. So states that coincide with frames equal them exactly. Textures per frame
    are those of the nearest frame.

    Args:
        asset: tracked mesh with one offset per frame of the motion.
        gaussians: the canonical cloud.
        deformation: its motion.
        frames: number of frames of the motion.
        fps: states per second of the result.

    Raises:
        BadInput: mesh and motion have different numbers of frames, or the result would have too few or too many states.
    """
    if len(asset.offsets) != frames:
        raise BadInput(f"the mesh has {len(asset.offsets)} frames, its motion has {frames}; extract the mesh again")
    if fps == asset.fps:
        return asset
    positions = resampled_positions(frames, asset.fps, fps)
    every = torch.arange(frames, dtype=torch.float64)
    unique, index = torch.cat([every, positions]).unique(return_inverse=True)
    skinned = _skin(asset, gaussians, deformation, frames, unique)
    at_frames, at_positions = skinned[index[:frames]], skinned[index[frames:]]
    nearest = positions.round().long() % frames
    return replace(
        asset,
        offsets=interpolate_frames(asset.offsets, positions)
        + (at_positions - interpolate_frames(at_frames, positions)),
        fps=fps,
        textures=None if asset.textures is None else asset.textures[nearest],
        reference_frame=asset.reference_frame * len(positions) / frames,
    )


def _skin(
    asset: Asset4D, gaussians: Gaussians, deformation: Deformation, frames: int, positions: Float[Tensor, " m"]
) -> Float[Tensor, "m v 3"]:
    """Skin the vertices to the Gaussians and return their offsets from rest at these positions."""
    rest = pose_gaussians(gaussians, deformation, frames, positions.new_tensor([asset.reference_frame])).at(0)
    states = pose_gaussians_in_chunks(gaussians, deformation, frames, positions)
    motion = Displacement(states.means - rest.means, states.log_scales - rest.log_scales, states.quats - rest.quats)
    return skin_vertices(asset.mesh.vertices, rest, motion)
