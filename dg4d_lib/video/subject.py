"""Subject preparation: matting, square cropping and resampling of input frames."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.images import over_white, resize_planes
from dg4d_lib.input_settings import SubjectSettings
from dg4d_lib.video import u2netp
from dg4d_lib.video.framing import (
    VISIBLE,
    Crop,
    bounding_box,
    crop_around_subject,
    crop_whole_frame,
    downscale,
    is_well_framed,
    reframe,
    resample,
)
from dg4d_lib.video.matting import Matte, matte
from dg4d_lib.video.segmentation_network import Segmentation, overlap
from dg4d_lib.video.soft_edges import free_colors

OVERSAMPLING = 2  # maximum size of opaque frames before matting, relative to the size of the square
SMALLEST_SUBJECT = 16  # longest side, pixels; a smaller subject has too few pixels to reconstruct
NAMED_AT_MOST = 8  # frames that a message lists
BOX_MARGIN = 0.1  # margin around a box that matting sees, as a share of its longest side
FOUND_MARGIN = 0.1  # margin around a found subject that may hold missed parts of it, as a share of its longest side
SAME_SUBJECT = 0.5  # overlap (IoU) of the estimates from the whole picture and from its part that shows the subject
UNCERTAIN = "so the outline is an estimate; if it is wrong, give a PNG with transparency, --mask FILE or --box X,Y,W,H."
NOTES = {
    "backdrop": "The background was removed by its plain color; a PNG with transparency gives a more exact outline.",
    "uneven backdrop": f"The background was removed by its color although it is uneven, {UNCERTAIN}",
    "network": f"The background was removed by the segmentation network {{name}}, {UNCERTAIN}",
}
COARSE = (
    "The subject covers a small part of the picture and was cut out of a reduced copy, so details are lost: "
    "give --box X,Y,W,H around it, or a picture that is cropped to it."
)
CERTAINTY = ("backdrop", "uneven backdrop", "network")  # methods of matting, the most exact first
Box = tuple[int, ...]  # left, top, width, height in pixels, or empty


@dataclass(frozen=True)
class Segmenter:
    """Network for opaque pictures.

    Attributes:
        name: in settings and notes.
        load: returns the network.
    """

    name: str = u2netp.NAME
    load: Callable[[], Segmentation] = u2netp.packaged_network


U2NETP = Segmenter()


@dataclass(frozen=True)
class PreparedSubject:
    """Cut-outs of a subject in one square frame.

    Attributes:
        frames: straight cut-outs with colors extended into transparent pixels.
        notes: sentences for the report.
        estimate: cut-outs in the frame of the source, if alpha was estimated; None if it was given.
        frame: height and width of the frames that were cropped, pixels; `estimate` may be smaller.
        crop: of these frames.
    """

    frames: Float[Tensor, "t s s 4"]
    frame: tuple[int, int]
    crop: Crop
    notes: tuple[str, ...] = ()
    estimate: Matte | None = None


@dataclass(frozen=True)
class _Shown:
    """Cut-outs of a part of the picture.

    Attributes:
        frames: cut-outs.
        frame: height and width of the whole picture, in pixels of the cut-outs.
        left, top: of the part, in pixels of the cut-outs.
    """

    frames: Float[Tensor, "t h w 4"]
    frame: tuple[int, int]
    left: int = 0
    top: int = 0


def _full_frame(frames: Float[Tensor, "t h w 4"]) -> _Shown:
    return _Shown(frames, (frames.shape[1], frames.shape[2]))


def prepare_subject(
    frames: Float[Tensor, "t h w 4"],
    has_alpha: bool,
    settings: SubjectSettings,
    mask: Float[Tensor, "t h w"] | None = None,
    segmenter: Segmenter = U2NETP,
) -> PreparedSubject:
    """Cut out, crop and resample the subject, the same way in all frames.

    Opaque frames are matted at a reduced size. Where the square would get fewer pixels than `settings.size` from these,
    the part that shows the subject is matted again, so that the crop has the resolution of the source.

    Args:
        frames: straight sRGB and alpha in [0, 1].
        has_alpha: True if alpha marks the subject.
        settings: matting, size of the square in pixels, framing and border; the box is in pixels of `frames`.
        mask: alpha from the user, which replaces that of the frames.
        segmenter: network for opaque frames.

    Raises:
        BadInput: nothing is visible in a frame, no subject is found, it is too small, or the box is outside.
        BackendUnavailable: the network is not installed.
    """
    check_box(settings.box, frames.shape[2], frames.shape[1])
    notes: tuple[str, ...] = ()
    estimate = None
    given = has_alpha or mask is not None
    if mask is not None:
        shown = _full_frame(apply_mask(frames, mask))
    elif settings.matting != "none" and not (settings.matting == "auto" and has_alpha):
        estimate, shown, notes = _estimated(frames, settings, segmenter)
        given = False
    else:
        shown = _full_frame(frames)
    if settings.box and estimate is None:
        shown = _full_frame(_inside(shown.frames, settings.box))
    alpha = shown.frames[..., 3]
    bounding_box(alpha)  # raises if no frame shows anything
    check_shown(alpha)
    left, top, right, bottom = bounding_box(alpha[:1])
    if max(right - left, bottom - top) < SMALLEST_SUBJECT:
        raise BadInput(
            f"the subject is {right - left} x {bottom - top} pixels; its longest side must have at least "
            f"{SMALLEST_SUBJECT} pixels: give a larger or closer picture"
        )
    keep = settings.framing == "keep" or (settings.framing == "auto" and given and is_well_framed(alpha))
    crop = crop_whole_frame(*alpha.shape[1:]) if keep else crop_around_subject(alpha, settings.border)
    if not (alpha <= VISIBLE).any():
        notes = (*notes, "The subject fills the whole picture, so there is no outline to build a shape from.")
    square = reframe(shown.frames, crop, settings.size)
    in_frame = Crop(crop.left + shown.left, crop.top + shown.top, crop.side)
    return PreparedSubject(square, shown.frame, in_frame, notes, estimate)


def check_shown(alpha: Float[Tensor, "t h w"]) -> None:
    """Refuse frames without a visible pixel.

    Raises:
        BadInput: names the frames, the first of which is 1.
    """
    empty = [str(number) for number, frame in enumerate(alpha, 1) if not (frame > VISIBLE).any()]
    if not empty:
        return
    named = empty if len(empty) <= NAMED_AT_MOST else [*empty[:NAMED_AT_MOST], f"{len(empty) - NAMED_AT_MOST} more"]
    listed = f"frames {', '.join(named[:-1])} and {named[-1]}" if len(named) > 1 else f"frame {named[0]}"
    raise BadInput(
        f"{listed} of {len(alpha)} show{'s' * (len(named) == 1)} no subject; trim the video, or correct --mask or --box"
    )


def check_box(box: Box, width: int, height: int) -> None:
    """Refuse a box that is not inside a picture of this size.

    Raises:
        BadInput: says where the box ends and how large the picture is.
    """
    if box and (box[0] + box[2] > width or box[1] + box[3] > height):
        raise BadInput(
            f"the box {','.join(map(str, box))} reaches to x = {box[0] + box[2]} and y = {box[1] + box[3]}, outside of "
            f"the picture of {width} x {height} pixels; give X,Y,W,H with X + W <= {width} and Y + H <= {height}"
        )


def apply_mask(frames: Float[Tensor, "t h w 4"], mask: Float[Tensor, "t h w"]) -> Float[Tensor, "t h w 4"]:
    """Return cut-outs with the user's alpha, and colors freed from the background where it is soft.

    Raises:
        BadInput: the mask of the first frame is empty.
    """
    if not (mask[0] > VISIBLE).any():
        raise BadInput(
            "the mask is empty: no pixel of the first frame is brighter than "
            f"{VISIBLE:.0%}; the subject must be white, the background black"
        )
    return torch.stack([free_colors(frame[..., :3], alpha) for frame, alpha in zip(frames, mask, strict=True)])


def _estimated(
    frames: Float[Tensor, "t h w 4"], settings: SubjectSettings, segmenter: Segmenter
) -> tuple[Matte, _Shown, tuple[str, ...]]:
    """Return the estimate in the frame of the source, cut-outs to crop from, and notes."""
    estimate = _estimate(frames, settings, segmenter)
    shown = _full_frame(estimate.frames)
    notes: tuple[str, ...] = ()
    if box := _small_subject(frames, estimate, settings):
        if closer := _look_closer(frames, box, estimate, settings, segmenter):
            estimate, shown = closer
        else:
            notes = (COARSE,)
    return estimate, shown, (NOTES[estimate.method].format(name=segmenter.name), *notes)


def _estimate(frames: Float[Tensor, "t h w 4"], settings: SubjectSettings, segmenter: Segmenter) -> Matte:
    """Cut the subject out of frames within the user's box, at full size if there is a box."""
    window = _window(settings.box, frames.shape[2], frames.shape[1])
    seen = frames[:, window[0], window[1]]
    found = _matte(seen, settings, segmenter)
    if not settings.box:
        return found
    cutouts = torch.zeros_like(frames)
    cutouts[..., :3] = frames[..., :3]
    for cutout, each in zip(cutouts, found.frames, strict=True):
        cutout[window] = resample(each[None], *seen.shape[1:3])[0]
    return replace(found, frames=_inside(cutouts, settings.box))


def _matte(frames: Float[Tensor, "t h w 4"], settings: SubjectSettings, segmenter: Segmenter) -> Matte:
    """Cut the subject out of frames, over white where they are transparent, at a reduced size."""
    method: Literal["auto", "backdrop", "network"] = "network"
    match settings.matting:
        case "auto" | "backdrop" as selected:
            method = selected
    opaque = torch.cat([over_white(frames), torch.ones_like(frames[..., 3:])], -1)
    small = downscale(opaque, OVERSAMPLING * settings.size)
    return matte(small[..., :3], method, segmenter.load)


def _small_subject(frames: Float[Tensor, "t h w 4"], estimate: Matte, settings: SubjectSettings) -> Box:
    """Return a box around a subject whose square lost pixels by the reduction before matting; else an empty one."""
    alpha = estimate.frames[..., 3]
    if settings.framing == "keep" or not (alpha > VISIBLE).any():
        return ()
    height, width = frames.shape[1:3]
    rows, columns = _window(settings.box, width, height)
    seen = max(rows.stop - rows.start, columns.stop - columns.start)
    scale = max(height, width) / max(alpha.shape[1:])
    reduction = max(1.0, seen / (OVERSAMPLING * settings.size))
    if reduction == 1 or crop_around_subject(alpha, settings.border).side * scale / reduction >= settings.size:
        return ()
    left, top, right, bottom = (edge * scale for edge in bounding_box(alpha))
    margin = FOUND_MARGIN * max(right - left, bottom - top) + reduction
    x, y, w, h = settings.box or (0, 0, width, height)
    left, top = max(x, math.floor(left - margin)), max(y, math.floor(top - margin))
    right, bottom = min(x + w, math.ceil(right + margin)), min(y + h, math.ceil(bottom + margin))
    return left, top, right - left, bottom - top


def _look_closer(
    frames: Float[Tensor, "t h w 4"], box: Box, estimate: Matte, settings: SubjectSettings, segmenter: Segmenter
) -> tuple[Matte, _Shown] | None:
    """Cut the subject out of the part of the frames around it; None if it is not found there again.

    Args:
        frames: the source.
        box: around the subject in all frames, pixels of `frames`.
        estimate: from the whole frames.
        settings: matting and size.
        segmenter: network.

    Returns:
        The estimate with its new alpha, in its own size, and cut-outs of the part in pixels of the source.
    """
    height, width = frames.shape[1:3]
    x, y, w, h = box
    rows, columns = _window(box, width, height)
    try:
        found = _matte(frames[:, rows, columns], settings, segmenter)
    except BadInput:
        return None
    inside = slice(y - rows.start, y - rows.start + h), slice(x - columns.start, x - columns.start + w)
    part = frames.new_empty(len(frames), h, w, 4)
    for cutout, each in zip(part, found.frames, strict=True):
        cutout[:] = resample(each[None], rows.stop - rows.start, columns.stop - columns.start)[0][inside]
    before = estimate.frames[..., 3]
    alpha = torch.zeros_like(before)
    place = _scaled(y, h, before.shape[1] / height), _scaled(x, w, before.shape[2] / width)
    small = alpha[:, place[0], place[1]]
    small[:] = resize_planes(part[None, ..., 3], small.shape[1:])[0]
    lost = (before > VISIBLE).any(2).any(1) & ~(alpha > VISIBLE).any(2).any(1)
    if lost.any() or overlap(alpha > 0.5, before > 0.5) < SAME_SUBJECT:
        return None
    agreements = [each.agreement for each in (estimate, found) if each.agreement is not None]
    merged = Matte(
        torch.cat([estimate.frames[..., :3], alpha[..., None]], -1),
        max(estimate.method, found.method, key=CERTAINTY.index),
        min(agreements, default=None),
        estimate.used_network or found.used_network,
    )
    return merged, _Shown(part, (height, width), x, y)


def _scaled(start: int, length: int, scale: float) -> slice:
    """Return the pixels of a span at another size, at least one."""
    first = round(scale * start)
    return slice(first, max(first + 1, round(scale * (start + length))))


def _window(box: Box, width: int, height: int) -> tuple[slice, slice]:
    """Return rows and columns of the box with a margin; of the whole picture without a box."""
    if not box:
        return slice(0, height), slice(0, width)
    x, y, w, h = box
    margin = round(BOX_MARGIN * max(w, h))
    return (
        slice(max(0, y - margin), min(height, y + h + margin)),
        slice(max(0, x - margin), min(width, x + w + margin)),
    )


def _inside(frames: Float[Tensor, "t h w 4"], box: Box) -> Float[Tensor, "t h w 4"]:
    """Make the pixels outside of a box transparent."""
    x, y, w, h = box
    kept = torch.zeros_like(frames[..., 3])
    kept[:, y : y + h, x : x + w] = frames[:, y : y + h, x : x + w, 3]
    return torch.cat([frames[..., :3], kept[..., None]], -1)
