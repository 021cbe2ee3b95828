"""White canvas of a video generator: the subject scaled to it, and cut out of the generated frames."""

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.images import over_white
from dg4d_lib.video.driving import DrivingVideo
from dg4d_lib.video.framing import resample
from dg4d_lib.video.matting import matte_from_first_alpha
from dg4d_lib.video.soft_edges import free_colors

MATTING_FAILED = (
    "The subject could not be separated from the background of a generated video; it keeps the outline of the input."
)
Window = tuple[slice, slice]  # rows and columns


def white_canvas(subject: Float[Tensor, "h w 4"], height: int, width: int) -> tuple[Float[Tensor, "y x 3"], Window]:
    """Scale the subject to a white canvas, centered; return the canvas and the rows and columns of the subject."""
    scale = min(height / subject.shape[0], width / subject.shape[1])
    rows, columns = (round(side * scale) for side in subject.shape[:2])
    small = resample(subject[None], rows, columns)[0]
    top, left = (height - rows) // 2, (width - columns) // 2
    window = slice(top, top + rows), slice(left, left + columns)
    canvas = subject.new_ones((height, width, 3))
    canvas[window] = over_white(small)
    return canvas, window


def cut_out(
    frames: Float[Tensor, "t y x 3"], subject: Float[Tensor, "h w 4"], fps: float
) -> tuple[DrivingVideo, tuple[str, ...]]:
    """Resize generated frames to the subject's size and matte them; if that fails, use the alpha of the input.

    Args:
        frames: the subject's window of the canvas over time.
        subject: input cut-out, straight alpha.
        fps: frames per second of playback.

    Returns:
        The video, and a note if the matting failed.
    """
    opaque = torch.cat([frames, torch.ones_like(frames[..., :1])], -1).to(subject)
    colors = resample(opaque, *subject.shape[:2])[..., :3]
    notes: tuple[str, ...] = ()
    try:
        cutouts = matte_from_first_alpha(colors, subject[..., 3])
    except BadInput:
        notes = (MATTING_FAILED,)
        cutouts = torch.stack([free_colors(frame, subject[..., 3]) for frame in colors])
    return DrivingVideo(cutouts[..., :3], cutouts[..., 3:], fps), notes
