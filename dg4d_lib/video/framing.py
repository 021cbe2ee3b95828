"""Where the subject lies in the frame: shrinking, cropping and resampling of cut-outs.

Colors are multiplied by alpha while pictures are resampled, so what hides under transparent pixels never bleeds in;
afterwards it is replaced by the nearest opaque color, so that later resampling shows no fringe either.
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

VISIBLE = 0.05  # alpha above which a pixel belongs to the subject's extent: fainter is noise of compression
OPAQUE = 0.9  # alpha from which a color is taken as the subject's own
FULL_ENOUGH = 0.3  # share of a frame that a subject must span to be kept where it is
CLEAR_OF_EDGE = 1 / 256  # of the frame, that must be free around a subject that is kept where it is


@dataclass(frozen=True)
class Crop:
    """A square of a picture; it may reach beyond the picture, where everything is transparent.

    Attributes:
        left: pixels from the picture's left edge; negative outside.
        top: pixels from its upper edge.
        side: pixels.
    """

    left: int
    top: int
    side: int


def bounding_box(alpha: Float[Tensor, "t h w"]) -> tuple[int, int, int, int]:
    """Left, top, right and bottom (one past the last pixel) of everything that is visible in any frame.

    Raises:
        BadInput: nothing is visible.
    """
    seen = (alpha > VISIBLE).any(0)
    if not seen.any():
        raise BadInput("the picture is fully transparent: there is no subject; give a picture that shows something")
    columns, rows = seen.any(0).nonzero().flatten(), seen.any(1).nonzero().flatten()
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def crop_whole_frame(height: int, width: int) -> Crop:
    """The smallest square around a picture; the picture is in its middle."""
    side = max(height, width)
    return Crop((width - side) // 2, (height - side) // 2, side)


def crop_around_subject(alpha: Float[Tensor, "t h w"], border: float) -> Crop:
    """The square in which the subject, over all frames, is centered and spans 1 - border of the side.

    Args:
        alpha: of every frame.
        border: share of the side that stays free, both margins together; 0 or more, below 1.

    Raises:
        BadInput: nothing is visible.
    """
    left, top, right, bottom = bounding_box(alpha)
    side = max(1, round(max(right - left, bottom - top) / (1 - border)))
    return Crop(round((left + right - side) / 2), round((top + bottom - side) / 2), side)


def is_well_framed(alpha: Float[Tensor, "t h w"]) -> bool:
    """Whether a square frame can stay as it is: the subject is inside, clear of the edge, and not tiny."""
    height, width = alpha.shape[1:]
    left, top, right, bottom = bounding_box(alpha)
    margin = max(1, round(CLEAR_OF_EDGE * height))
    inside = min(left, top, width - right, height - bottom) >= margin
    return height == width and inside and max(right - left, bottom - top) >= FULL_ENOUGH * height


def reframe(frames: Float[Tensor, "t h w 4"], crop: Crop, size: int) -> Float[Tensor, "t s s 4"]:
    """The crop of every frame at `size` pixels a side; straight alpha, color extended under what is transparent."""
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
    """Return the same frames with no side longer than `longest` pixels; smaller ones stay as they are."""
    height, width = downscaled_size(frames.shape[1], frames.shape[2], longest)
    return resample(frames, height, width)


def downscaled_size(height: int, width: int, longest: int) -> tuple[int, int]:
    """Return height and width in pixels after `downscale`."""
    if max(height, width) <= longest:
        return height, width
    scale = longest / max(height, width)
    return max(1, round(height * scale)), max(1, round(width * scale))


def resample(frames: Float[Tensor, "t h w 4"], height: int, width: int) -> Float[Tensor, "t h2 w2 4"]:
    """Resample cut-outs, antialiased, weighted by alpha; equal size gives equal values."""
    if (height, width) == tuple(frames.shape[1:3]):
        return frames
    alpha = frames[..., 3:]
    weighted = torch.cat([frames[..., :3] * alpha, alpha], -1).permute(0, 3, 1, 2)
    return unpremultiply(resize_planes(weighted, (height, width)))


def unpremultiply(frames: Float[Tensor, "t 4 h w"]) -> Float[Tensor, "t h w 4"]:
    """Return frames whose colors are divided by alpha, channels last, all in [0, 1]."""
    small = frames.permute(0, 2, 3, 1).clamp(0, 1)
    color = small[..., :3] / small[..., 3:].clamp(min=1e-6)
    return torch.cat([color.clamp(0, 1), small[..., 3:]], -1).contiguous()


def extend_color(cutout: Float[Tensor, "h w 4"]) -> Float[Tensor, "h w 4"]:
    """Transparent pixels get the color of the nearest opaque one; nothing visible changes."""
    alpha = cutout[..., 3]
    reliable = alpha >= min(OPAQUE, float(alpha.max()))
    hidden = alpha <= 1 / 512
    if not hidden.any() or not (alpha > 0).any():
        return cutout
    color = torch.where(hidden[..., None], nearest_color(cutout[..., :3], reliable), cutout[..., :3])
    return torch.cat([color, alpha[..., None]], -1)


def nearest_color(color: Float[Tensor, "h w 3"], source: Bool[Tensor, "h w"]) -> Float[Tensor, "h w 3"]:
    """Every pixel's color, or where it is no source the color of the nearest source; there must be one."""
    indices = ndimage.distance_transform_edt(~source.cpu().numpy(), return_distances=False, return_indices=True)
    rows, columns = torch.from_numpy(np.asarray(indices[0])).long(), torch.from_numpy(np.asarray(indices[1])).long()
    return color[rows.to(color.device), columns.to(color.device)]
