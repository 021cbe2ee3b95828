"""Other frame rates: the motion is a function of time, so it can be asked at any moment."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.assets.animated import Asset4D, interpolate_frames, pose_gaussians
from dg4d_lib.deformation.interface import Deformation, Displacement
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.mesh.tracking.skinning import skin_vertices

MOST_STATES = 1000  # a GLB holds a morph target per state, and weights for all of them at every key
STATES_AT_ONCE = 32  # bounds the memory


def resampled_positions(frames: int, fps: float, wanted: float) -> Float[Tensor, " m"]:
    """The positions of the states of a closed animation at another frame rate: round(frames * wanted / fps) of them.

    They part the loop evenly and begin with the first frame. The loop lasts as long as before, to half a state.

    Args:
        frames: of the animation.
        fps: its frames per second.
        wanted: states per second.

    Returns:
        In [0, frames); float64, so that frames are met exactly.

    Raises:
        BadInput: there would be more than 1,000 states, and more than frames.
    """
    count = max(1, round(frames * wanted / fps))
    if count > max(MOST_STATES, frames):
        raise BadInput(
            f"{wanted:g} frames per second would be {count} states of this motion of {frames / fps:.3g} s; at most "
            f"{MOST_STATES} are written: choose at most {MOST_STATES * fps / frames:.4g}"
        )
    return torch.arange(count, dtype=torch.float64) * frames / count


def pose_gaussians_in_chunks(
    gaussians: Gaussians, deformation: Deformation, frames: int, positions: Float[Tensor, " m"]
) -> Gaussians:
    """What `pose_gaussians` gives, a few positions at a time: networks need far more memory than the states they make."""
    parts = [pose_gaussians(gaussians, deformation, frames, part) for part in positions.split(STATES_AT_ONCE)]
    return replace(
        gaussians,
        means=torch.cat([part.means for part in parts]),
        log_scales=torch.cat([part.log_scales for part in parts]),
        quats=torch.cat([part.quats for part in parts]),
    )


def resample_asset(asset: Asset4D, gaussians: Gaussians, deformation: Deformation, frames: int, fps: float) -> Asset4D:
    """A tracked mesh at another frame rate.

    Between frames its vertices ride the Gaussians of that moment, as they did at the frames; what they were corrected
    by at the frames goes over from one frame to the next linearly. So frames that are met are exactly as they were.
    Textures that change are those of the nearest frame.

    Args:
        asset: one offset per frame, at the clock of the frames.
        gaussians: canonical.
        deformation: of theirs.
        frames: of the deformation.
        fps: states per second of the result.

    Raises:
        BadInput: the mesh has another number of frames than the motion, or there would be too many states.
    """
    if len(asset.offsets) != frames:
        raise BadInput(f"the mesh has {len(asset.offsets)} frames, its motion {frames}; extract the mesh again")
    if fps == asset.fps:
        return asset
    positions = resampled_positions(frames, asset.fps, fps)
    every = torch.arange(frames, dtype=torch.float64)
    asked, places = torch.cat([every, positions]).unique(return_inverse=True)
    carried = _carried(asset, gaussians, deformation, frames, asked)
    at_frames, there = carried[places[:frames]], carried[places[frames:]]
    nearest = positions.round().long() % frames
    return replace(
        asset,
        offsets=interpolate_frames(asset.offsets, positions) + (there - interpolate_frames(at_frames, positions)),
        fps=fps,
        textures=None if asset.textures is None else asset.textures[nearest],
        reference_frame=asset.reference_frame * len(positions) / frames,
    )


def _carried(
    asset: Asset4D, gaussians: Gaussians, deformation: Deformation, frames: int, positions: Float[Tensor, " m"]
) -> Float[Tensor, "m v 3"]:
    """How far the vertices have ridden from rest at these positions."""
    rest = pose_gaussians(gaussians, deformation, frames, positions.new_tensor([asset.reference_frame])).at(0)
    there = pose_gaussians_in_chunks(gaussians, deformation, frames, positions)
    since_rest = Displacement(there.means - rest.means, there.log_scales - rest.log_scales, there.quats - rest.quats)
    return skin_vertices(asset.mesh.vertices, rest, since_rest)
