"""Cropping and resampling of cut-outs.

Images are resampled with premultiplied alpha, so colors under transparent pixels never bleed in. Afterwards these are
replaced by the nearest opaque color, so that later resampling shows no fringe either.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

from dg4d_lib.errors import BadInput
from dg4d_lib.images import resize_planes

VISIBLE = 0.05  # alpha above which a pixel counts for the bounding box; fainter pixels are compression noise
OPAQUE = 0.9  # alpha from which a color is the subject's own
FULL_ENOUGH = 0.3  # share of the frame that a subject must span for the framing to be kept
CLEAR_OF_EDGE = 1 / 256  # margin around the subject, as a share of the frame, for the framing to be kept


@dataclass(frozen=True)
class Crop:
    """Square crop of an image; it may extend beyond the image, where it is transparent.

    Attributes:
        left: pixels from the image's left edge; negative outside.
        top: pixels from the image's upper edge; negative outside.
        side: pixels.
    """

    left: int
    top: int
    side: int


def bounding_box(alpha: Float[Tensor, "t h w"]) -> tuple[int, int, int, int]:
    """Return left, top, right and bottom (one past the last pixel) of the visible pixels of all frames.

    Raises:
        BadInput: nothing is visible.
    """
    seen = (alpha > VISIBLE).any(0)
    if not seen.any():
        raise BadInput("the picture is fully transparent, so there is no subject; give a picture with visible pixels")
    columns, rows = seen.any(0).nonzero().flatten(), seen.any(1).nonzero().flatten()
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def crop_whole_frame(height: int, width: int) -> Crop:
    """Return the smallest square that contains the image, centered."""
    side = max(height, width)
    return Crop((width - side) // 2, (height - side) // 2, side)


def crop_around_subject(alpha: Float[Tensor, "t h w"], border: float) -> Crop:
    """Return the square in which the subject, over all frames, is centered and spans 1 - border of the side.

    Args:
        alpha: of every frame.
        border: empty share of the side, both margins together, in [0, 1).

    Raises:
        BadInput: nothing is visible.
    """
    left, top, right, bottom = bounding_box(alpha)
    side = max(1, round(max(right - left, bottom - top) / (1 - border)))
    return Crop(round((left + right - side) / 2), round((top + bottom - side) / 2), side)


def is_well_framed(alpha: Float[Tensor, "t h w"]) -> bool:
    """Return True if a frame is square and its subject large enough and clear of the edges, so that it can be kept."""
    height, width = alpha.shape[1:]
    left, top, right, bottom = bounding_box(alpha)
    margin = max(1, round(CLEAR_OF_EDGE * height))
    inside = min(left, top, width - right, height - bottom) >= margin
    return height == width and inside and max(right - left, bottom - top) >= FULL_ENOUGH * height


def reframe(frames: Float[Tensor, "t h w 4"], crop: Crop, size: int) -> Float[Tensor, "t s s 4"]:
    """Crop every frame and resample it to `size` pixels a side; straight alpha, colors extended outwards."""
    height, width = frames.shape[1:3]
    left, top = max(0, crop.left), max(0, crop.top)
    right, bottom = min(width, crop.left + crop.side), min(height, crop.top + crop.side)
    pad = (0, 0, left - crop.left, crop.left + crop.side - right, top - crop.top, crop.top + crop.side - bottom)
    framed = [
        extend_color(resample(functional.pad(frame[top:bottom, left:right], pad)[None], size, size)[0])
        for frame in frames
    ]
    return torch.stack(framed)


def downscale(frames: Float[Tensor, "t h w 4"], longest: int) -> Float[Tensor, "t h2 w2 4"]:
    """Downscale frames to a longest side of `longest` pixels; smaller frames are returned unchanged."""
    height, width = downscaled_size(frames.shape[1], frames.shape[2], longest)
    if (height, width) == tuple(frames.shape[1:3]):
        return frames
    return torch.cat([resample(frame[None], height, width) for frame in frames])  # all at once: twice the memory


def downscaled_size(height: int, width: int, longest: int) -> tuple[int, int]:
    """Return height and width in pixels that `downscale` gives."""
    if max(height, width) <= longest:
        return height, width
    scale = longest / max(height, width)
    return max(1, round(height * scale)), max(1, round(width * scale))


def resample(frames: Float[Tensor, "t h w 4"], height: int, width: int) -> Float[Tensor, "t h2 w2 4"]:
    """Resample cut-outs with antialiasing and premultiplied alpha; frames of this size are returned unchanged."""
    if (height, width) == tuple(frames.shape[1:3]):
        return frames
    alpha = frames[..., 3:]
    weighted = torch.cat([frames[..., :3] * alpha, alpha], -1).permute(0, 3, 1, 2)
    return unpremultiply(resize_planes(weighted, (height, width)))


def unpremultiply(frames: Float[Tensor, "t 4 h w"]) -> Float[Tensor, "t h w 4"]:
    """Divide colors by alpha; return frames with channels last, in [0, 1]."""
    rgba = frames.permute(0, 2, 3, 1).clamp(0, 1)
    color = rgba[..., :3] / rgba[..., 3:].clamp(min=1e-6)
    return torch.cat([color.clamp(0, 1), rgba[..., 3:]], -1).contiguous()


def extend_color(cutout: Float[Tensor, "h w 4"]) -> Float[Tensor, "h w 4"]:
    """Give transparent pixels the color of the nearest opaque one; nothing visible changes."""
    alpha = cutout[..., 3]
    reliable = alpha >= min(OPAQUE, float(alpha.max()))
    hidden = alpha <= 1 / 512
    if not hidden.any() or not (alpha > 0).any():
        return cutout
    color = torch.where(hidden[..., None], nearest_color(cutout[..., :3], reliable), cutout[..., :3])
    return torch.cat([color, alpha[..., None]], -1)


def nearest_color(color: Float[Tensor, "h w 3"], source: Bool[Tensor, "h w"]) -> Float[Tensor, "h w 3"]:
    """Replace the color of every pixel outside `source` by that of the nearest source pixel; there must be one."""
    indices = ndimage.distance_transform_edt(~source.cpu().numpy(), return_distances=False, return_indices=True)
    rows, columns = torch.from_numpy(np.asarray(indices[0])).long(), torch.from_numpy(np.asarray(indices[1])).long()
    return color[rows.to(color.device), columns.to(color.device)]
