"""Matting of opaque frames without learned weights: subject mask, alpha and foreground colors."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy import ndimage
from skimage.color import rgb2lab
from torch import Tensor
from torch.nn import functional

from dg4d_lib.errors import BadInput
from dg4d_lib.images import resize_planes
from dg4d_lib.video.backdrop import border_ring, cut_out, fit_backdrop
from dg4d_lib.video.saliency import segment

PLAIN_SIDE = 640  # longest side for the segmentation before plain backdrops, pixels
PHOTO_SIDE = 192  # longest side for the segmentation of photographs, pixels
MIN_AREA = 0.005  # minimum share of the first frame that the subject covers
MAX_AREA = 0.95  # maximum share of the first frame that the subject covers
MAX_BORDER = 0.85  # maximum share of the border that the subject touches
MIN_SEPARATION = 0.75  # of the color models; see saliency.Segmentation
PART = 0.02  # minimum area of a part relative to the largest one; smaller parts are dropped
PHOTO_PART = 0.3  # the same in photographs, where small parts are more often mistakes
STILL = 0.04  # change of color, in [0, 1], below which a pixel counts as static between two frames
KEPT = 0.8  # weight of the previous frame's alpha at static pixels
ADVICE = "give a PNG with a transparent background, or a picture of one subject before a plain backdrop"


@dataclass(frozen=True)
class Matte:
    """Cut-outs and the segmentation method.

    Attributes:
        frames: cut-outs with straight alpha; colors are free of the background.
        method: segmentation method; all but "backdrop" are guesses.
    """

    frames: Float[Tensor, "t h w 4"]
    method: Literal["backdrop", "uneven backdrop", "color models"]


def matte(frames: Float[Tensor, "t h w 3"]) -> Matte:
    """Cut the subject out of opaque frames; all of them share one model of the background.

    Raises:
        BadInput: no subject is found.
    """
    height, width = frames.shape[1:3]
    lab = _lab(frames, PLAIN_SIDE)
    backdrop = fit_backdrop(lab)
    if backdrop.is_plain:
        masks, radius = np.stack([_parts(mask, PART) for mask in cut_out(lab, backdrop)]), 2
    else:
        lab = _lab(frames, PHOTO_SIDE)
        found = segment(lab)
        if found.separation < MIN_SEPARATION:
            raise BadInput(f"no subject found: its colors are too similar to those of the background; {ADVICE}")
        masks = np.stack([_compact(frame > 0.5) for frame in found.likelihood])
        radius = 2
    _check(masks[0])
    scale = max(height, width) / max(masks.shape[1:])
    band = max(2, round(radius * max(1.0, scale)))
    cutouts = frames.new_empty(len(frames), height, width, 4)  # filled one by one, since frames may take 0.5 GB
    for cutout, frame, mask in zip(cutouts, frames, masks, strict=True):
        cutout[:] = _estimate_alpha(frame, _upscale(mask[None], height, width)[0], band)
    _stabilize(cutouts, frames)
    if not backdrop.is_plain:
        return Matte(cutouts, "color models")
    return Matte(cutouts, "backdrop" if backdrop.is_even else "uneven backdrop")


def matte_from_first_alpha(frames: Float[Tensor, "t h w 3"], first: Float[Tensor, "h w"]) -> Float[Tensor, "t h w 4"]:
    """Cut out frames with known alpha of the first frame, without flicker.

    Mattes of single frames are uncertain along the outline. A pixel whose color stays from one frame to the next also
    keeps most of its alpha, which propagates the known alpha of the first frame and averages out noise. Moving pixels
    are not changed.

    Args:
        frames: opaque frames in [0, 1].
        first: alpha of the first frame.

    Returns:
        Cut-outs with straight alpha.

    Raises:
        BadInput: no subject is found.
    """
    cutouts = matte(frames).frames.clone()
    cutouts[0] = torch.cat([frames[0], first[..., None]], -1)
    weights = KEPT * torch.exp(-((frames[1:] - frames[:-1]).abs().amax(-1) / STILL).square())
    for i, weight in enumerate(weights, 1):
        cutouts[i, ..., 3] = torch.lerp(cutouts[i, ..., 3], cutouts[i - 1, ..., 3], weight)
    return cutouts


def _lab(frames: Float[Tensor, "t h w 3"], longest: int) -> Float[ndarray, "t h2 w2 3"]:
    """Convert frames to CIE Lab, downscaled to a longest side and slightly blurred against pixel noise."""
    scale = longest / max(frames.shape[1:3])
    size = [max(8, round(side * scale)) for side in frames.shape[1:3]] if scale < 1 else list(frames.shape[1:3])
    lab = np.empty((len(frames), *size, 3), np.float32)
    for i, frame in enumerate(frames):
        small = frame.permute(2, 0, 1)[None]
        if scale < 1:
            small = resize_planes(small, size)
        lab[i] = ndimage.gaussian_filter(rgb2lab(small[0].permute(1, 2, 0).cpu().numpy()), (0.6, 0.6, 0))
    return lab


def _compact(mask: Bool[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Close narrow gaps and holes of a photograph's mask, and remove wisps and small parts."""
    disc = np.hypot(*np.mgrid[-3:4, -3:4]) < 3.5
    closed = ndimage.binary_closing(np.pad(mask, 4, mode="edge"), disc)[4:-4, 4:-4]
    opened = ndimage.binary_opening(ndimage.binary_fill_holes(closed), disc[1:-1, 1:-1])
    return _parts(opened, PHOTO_PART)


def _parts(mask: Bool[ndarray, "h w"], min_share: float) -> Bool[ndarray, "h w"]:
    """Keep the connected parts of at least this area relative to the largest one."""
    labels, count = ndimage.label(mask, np.ones((3, 3)))
    if count == 0:
        return mask
    areas = ndimage.sum_labels(mask, labels, np.arange(1, count + 1))
    return np.isin(labels, 1 + np.flatnonzero(areas >= max(4, min_share * areas.max())))


def _check(mask: Bool[ndarray, "h w"]) -> None:
    share = float(mask.mean())
    if share < MIN_AREA:
        found = "the picture is the same everywhere" if share == 0 else f"the foreground covers {share:.2%} of it"
        raise BadInput(f"no subject found: {found}, a subject must cover at least {MIN_AREA:.1%}; {ADVICE}")
    touched = float(mask[border_ring(*mask.shape)].mean())
    if share > MAX_AREA or touched > MAX_BORDER:
        raise BadInput(
            f"no subject found: the foreground covers {share:.0%} of the picture and {touched:.0%} of its border, at "
            f"most {MAX_AREA:.0%} and {MAX_BORDER:.0%} are allowed; {ADVICE}"
        )


def _upscale(masks: Bool[ndarray, "t h w"], height: int, width: int) -> Bool[ndarray, "t h2 w2"]:
    if masks.shape[1:] == (height, width):
        return masks
    soft = torch.from_numpy(masks).float()[:, None]
    large = functional.interpolate(soft, (height, width), mode="bicubic", align_corners=False)
    return (large[:, 0] > 0.5).numpy()


def _estimate_alpha(picture: Float[Tensor, "h w 3"], mask: Bool[ndarray, "h w"], band: int) -> Float[Tensor, "h w 4"]:
    """Estimate alpha and foreground color in a band along the outline.

    A pixel there mixes the colors of the nearby subject and the nearby background: alpha is its position on the line
    between these two colors, and the foreground color is the pixel without the background's part.
    """
    cutout = torch.cat([picture, torch.zeros_like(picture[..., :1])], -1)
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return cutout
    margin = 4 * band
    window = (
        slice(max(0, rows[0] - margin), rows[-1] + margin),
        slice(max(0, columns[0] - margin), columns[-1] + margin),
    )
    cutout[window] = _unmix(picture[window], mask[window], band)
    return cutout


def _unmix(picture: Float[Tensor, "h w 3"], mask: Bool[ndarray, "h w"], band: int) -> Float[Tensor, "h w 4"]:
    image = picture.cpu().numpy().astype(np.float64)
    inside, outside = ndimage.distance_transform_edt(mask), ndimage.distance_transform_edt(~mask)
    core = mask & (inside > np.minimum(band, 0.75 * ndimage.maximum_filter(inside, 2 * band + 1)))
    away = outside > band
    if not core.any() or not away.any():
        return torch.cat([picture, torch.from_numpy(mask).to(picture)[..., None]], -1)
    front, back = _extrapolate(image, core, band), _extrapolate(image, away, band)
    line = front - back
    length = (line**2).sum(-1)
    mixed = ((image - back) * line).sum(-1) / np.maximum(length, 1e-6)
    geometric = ndimage.gaussian_filter(mask.astype(np.float64), 0.5 * band)
    trust = np.clip(length / 0.04, 0, 1)  # colors that differ by 0.2 in the unit cube determine alpha reliably
    alpha = np.clip((trust * mixed + (1 - trust) * geometric - 0.04) / 0.92, 0, 1)
    alpha = np.where(core, 1.0, np.where(away, 0.0, alpha))
    pure = (image - (1 - alpha[..., None]) * back) / np.maximum(alpha[..., None], 1e-3)
    color = np.where(core[..., None], image, front + alpha[..., None] * (np.clip(pure, 0, 1) - front))
    return torch.from_numpy(np.dstack([color, alpha]).clip(0, 1)).to(picture)


def _extrapolate(image: Float[ndarray, "h w 3"], source: Bool[ndarray, "h w"], band: int) -> Float[ndarray, "h w 3"]:
    """Extrapolate the source pixels' colors: a local mean near them, the nearest color farther away."""
    weight = ndimage.gaussian_filter(source.astype(np.float64), band)
    mean = ndimage.gaussian_filter(image * source[..., None], (band, band, 0)) / np.maximum(weight, 1e-9)[..., None]
    nearest = ndimage.distance_transform_edt(~source, return_distances=False, return_indices=True)
    return np.where((weight > 1e-3)[..., None], mean, image[nearest[0], nearest[1]])


def _stabilize(cutouts: Float[Tensor, "t h w 4"], frames: Float[Tensor, "t h w 3"]) -> None:
    """Replace the alpha of static pixels by its median over three frames."""
    count = len(cutouts)
    if count < 3:
        return
    alpha = cutouts[..., 3].clone()
    still = [(frames[i + 1] - frames[i]).abs().amax(-1) < STILL for i in range(count - 1)]
    for i in range(count):
        before, after = still[max(0, i - 1)], still[min(i, count - 2)]
        near = torch.stack([alpha[max(0, i - 1)], alpha[i], alpha[min(i + 1, count - 1)]])
        cutouts[i, ..., 3] = torch.where(before & after, near.median(0).values, alpha[i])
