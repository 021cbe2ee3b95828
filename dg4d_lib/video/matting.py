"""Matting of opaque frames: subject mask, alpha and foreground colors."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy import ndimage
from scipy.special import expit, logit
from skimage.color import rgb2lab
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.images import resize_planes
from dg4d_lib.video import u2netp
from dg4d_lib.video.backdrop import Backdrop, border_ring, colored_alike, cut_out, fit_backdrop, has_pattern
from dg4d_lib.video.border_colors import BorderDistances, color_evidence, missing_parts
from dg4d_lib.video.color_models import foreground_log_odds
from dg4d_lib.video.contradictions import consistent_answers, resized_answer
from dg4d_lib.video.guided_filter import guide_to_edges
from dg4d_lib.video.segmentation_network import BORDER_MARGIN, MIN_AREA, Segmentation, border_contact, overlap
from dg4d_lib.video.soft_edges import free_colors, unmix
from dg4d_lib.video.still_pixels import average_still_pixels

Method = Literal["backdrop", "uneven backdrop", "network"]
NetworkLoader = Callable[[], Segmentation]

BACKDROP_SIDE = 640  # longest side for the segmentation in front of plain backdrops, pixels
REFINED_SIDE = 512  # longest side for color models and for the coefficients of the guided filter, pixels
MAX_AREA = 0.95  # maximum share of the first frame that the subject covers
MAX_BORDER = 0.85  # maximum share of the border that the subject touches
PART = 0.02  # minimum area of a part relative to the largest one; smaller parts are dropped
PATTERN_KEEPS = 0.6  # minimum area of a subject without a pattern's colors, relative to the one with them
AGREED = 0.9  # overlap (IoU) from which backdrop and network are taken to have found the same subject
BAND = 2  # half of the band along an outline before a plain backdrop, pixels of the segmentation
TELLING = 0.92  # share of subject and background, on average, that their colors tell apart where colors are trusted
SURE = {True: 0.07, False: 0.012}  # bound of the segmentation's log odds, as a probability, by trust in colors
COLOR_SHARE = 0.5  # weight of the color models in the log odds; the rest is the segmentation's
PARTS_SIDE = 256  # longest side for the search of missing parts, pixels
COLORS_SIDE = 128  # longest side for color models in all rounds but the last, pixels
ROUNDS = {True: 4, False: 2}  # alternations of color models and segmentation, as in GrabCut, by trust in colors
CROP_MARGIN = 0.12  # margin of the crop for the second segmentation, as a share of the subject's longest side
CROP_SURE = 0.3  # probability from which a pixel counts for the crop
UNSURE = 0.005  # bound of the segmentation's probabilities before the evidence of colors
FUSED = 0.9  # probability of pixels that differ from an even backdrop
CLEAN_SHARE = 0.98  # minimum share of the border that an even backdrop and the subject explain
ISLANDS = 0.05  # maximum area of other objects before an even backdrop, relative to the subject
FILTER_RADIUS = 3 / 256  # of the guided filter, as a share of the longest side
FILTER_EPS = 1e-3  # color variance below which the guided filter smooths
STEEPNESS = 2.0  # slope that turns the filtered probability into alpha: edges are a pixel or two wide
CHECKED_FRAMES = 4  # frames that a second method segments, evenly spaced
KEPT = 0.8  # weight of the previous frame's alpha at static pixels
STILL = 0.04  # change of color, in [0, 1], below which a pixel counts as static between two frames
ADVICE = (
    "give a PNG with a transparent background, a mask (--mask FILE), the part of the picture that shows the subject "
    "(--box X,Y,W,H), or a picture of one subject in front of a plain backdrop"
)


@dataclass(frozen=True)
class Matte:
    """Cut-outs and the segmentation method.

    Attributes:
        frames: cut-outs with straight alpha; colors are free of the background.
        method: segmentation method; all but "backdrop" are estimates that may be wrong.
        agreement: overlap (IoU) with a second method in the worst checked frame; if there is no other one, with the
            network's answer to the mirrored picture, and, before colors changed it, with its answer or with these
            colors alone; None if there is none at all.
        used_network: True if the result depends on the network's weights.
    """

    frames: Float[Tensor, "t h w 4"]
    method: Method
    agreement: float | None = None
    used_network: bool = False


def matte(
    frames: Float[Tensor, "t h w 3"],
    method: Literal["auto", "backdrop", "network"] = "auto",
    load: NetworkLoader = u2netp.packaged_network,
) -> Matte:
    """Cut the subject out of opaque frames; all of them share one model of the background.

    Args:
        frames: sRGB in [0, 1].
        method: "backdrop": by the color of a plain backdrop; "network": by a segmentation network; "auto": by both
            before a plain backdrop, else by the network.
        load: returns the network.

    Raises:
        BadInput: no subject is found.
        BackendUnavailable: the network is not installed.
    """
    found = _segment(frames, method, load)
    _check(found.probability[0].numpy() > 0.5)
    cutouts = frames.new_empty(*frames.shape[:3], 4)  # filled one by one, since frames may take 0.5 GB
    if found.is_exact:
        scale = max(frames.shape[1:3]) / max(found.probability.shape[1:])
        for cutout, frame, mask in zip(cutouts, frames, found.probability, strict=True):
            large = resize_planes(mask[None, None], frames.shape[1:3], "bicubic")[0, 0] > 0.5
            cutout[:] = unmix(frame, large.numpy(), max(2, round(BAND * max(1.0, scale))))
        cutouts[..., 3] = average_still_pixels(cutouts[..., 3], frames)
    else:
        likelihood = _refine(frames, average_still_pixels(found.probability, _resized(frames, found.probability)))
        for cutout, frame, alpha in zip(cutouts, frames, likelihood, strict=True):
            cutout[:] = free_colors(frame, alpha)
    _check(cutouts[0, ..., 3].cpu().numpy() > 0.5)
    return Matte(cutouts, found.method, found.agreement, found.used_network)


def matte_from_first_alpha(frames: Float[Tensor, "t h w 3"], first: Float[Tensor, "h w"]) -> Float[Tensor, "t h w 4"]:
    """Cut out frames with known alpha of the first frame, without flicker.

    Mattes of single frames are uncertain along the outline. A pixel whose color stays from one frame to the next also
    keeps most of its alpha, which propagates the known alpha of the first frame and averages out noise. Moving pixels
    are not changed.

    Args:
        frames: opaque frames in [0, 1].
        first: alpha of the first frame.

    Returns:
        Cut-outs with straight alpha; colors are free of the background.

    Raises:
        BadInput: no subject is found.
    """
    alphas = matte(frames).frames[..., 3].clone()
    alphas[0] = first
    weights = KEPT * torch.exp(-((frames[1:] - frames[:-1]).abs().amax(-1) / STILL).square())
    for i, weight in enumerate(weights, 1):
        alphas[i] = torch.lerp(alphas[i], alphas[i - 1], weight)
    return torch.stack([free_colors(frame, alpha) for frame, alpha in zip(frames, alphas, strict=True)])


@dataclass(frozen=True)
class _Segmentation:
    """Segmentation of all frames.

    Attributes:
        probability: of the subject, at reduced size.
        is_exact: True for masks by a plain backdrop's color that no other method contradicts.
        method, agreement, used_network: see `Matte`.
    """

    probability: Float[Tensor, "t h w"]
    method: Method
    agreement: float | None
    used_network: bool
    is_exact: bool = False


def _segment(frames: Float[Tensor, "t h w 3"], method: str, load: NetworkLoader) -> _Segmentation:
    if method == "network":
        return _by_network(frames, load())
    lab = _lab(frames, BACKDROP_SIDE)
    backdrop = fit_backdrop(lab)
    if method == "auto" and not backdrop.is_plain:
        return _by_network(frames, load())
    masks = _by_backdrop(lab, backdrop)
    if method == "backdrop":
        return _Segmentation(masks, _name_of(backdrop), None, False, is_exact=True)
    return _by_both(frames, masks, backdrop, load())


def _by_both(
    frames: Float[Tensor, "t h w 3"], masks: Float[Tensor, "t h2 w2"], backdrop: Backdrop, network: Segmentation
) -> _Segmentation:
    """Choose between masks by a plain backdrop and the network's, or fuse them before an even one."""
    checked = _spread(len(frames))
    known = {i: network.probability(frames[i]) for i in checked}
    second = resize_planes(torch.stack(list(known.values()))[None], masks.shape[1:])[0]
    agreement = min(overlap(masks[i] > 0.5, other > 0.5) for i, other in zip(checked, second, strict=True))
    if agreement >= AGREED and (backdrop.is_uniform or len(frames) > 1):  # the network on all frames would take long
        return _Segmentation(masks, _name_of(backdrop), agreement, True, is_exact=True)
    touched = border_contact(second > 0.5)
    if agreement < AGREED and touched > border_contact(masks[checked] > 0.5) + BORDER_MARGIN:
        return _Segmentation(masks, _name_of(backdrop), agreement, True)
    found = _by_network(frames, network, known)
    subject = _subject_before(masks, found.probability) if backdrop.is_uniform else None
    contact = 0.0 if subject is None else border_contact(subject)
    if subject is None or backdrop.share + contact < CLEAN_SHARE or contact > touched + 2 * BORDER_MARGIN:
        return found
    fused = torch.maximum(found.probability, FUSED * subject.float())
    return _Segmentation(fused, "network", min(agreement, found.agreement or 0.0), True)


def _name_of(backdrop: Backdrop) -> Method:
    return "backdrop" if backdrop.is_even else "uneven backdrop"


def _subject_before(
    masks: Float[Tensor, "t h w"], probability: Float[Tensor, "t h2 w2"]
) -> Bool[Tensor, "t h2 w2"] | None:
    """Return the parts of masks by an even backdrop that the network's subject touches; None if there are many others.

    Others are a sign that the backdrop is even along the border alone: stars, lights, stains.
    """
    kept = []
    for mask, found in zip(resize_planes(masks[None], probability.shape[1:])[0] > 0.5, probability > 0.5, strict=True):
        labels, _ = ndimage.label(mask.numpy(), np.ones((3, 3)))
        kept.append(np.isin(labels, np.unique(labels[found.numpy() & (labels > 0)])) & (labels > 0))
        if (labels > 0).sum() > (1 + ISLANDS) * kept[-1].sum():
            return None
    return torch.from_numpy(np.stack(kept))


def _by_backdrop(lab: Float[ndarray, "t h w 3"], backdrop: Backdrop) -> Float[Tensor, "t h w"]:
    subject, spots = _without_spots(cut_out(lab, backdrop))
    if has_pattern(subject, spots):
        again, _ = _without_spots(cut_out(lab, backdrop, colored_alike(lab, spots)))
        subject = again if again.sum() >= PATTERN_KEEPS * subject.sum() else subject
    return torch.from_numpy(subject).float()


def _without_spots(masks: Bool[ndarray, "t h w"]) -> tuple[Bool[ndarray, "t h w"], Bool[ndarray, "t h w"]]:
    """Return the large parts of masks, and the small ones."""
    kept = np.stack([_parts(mask, PART) for mask in masks])
    return kept, masks & ~kept


def _by_network(
    frames: Float[Tensor, "t h w 3"],
    network: Segmentation,
    known: Mapping[int, Float[Tensor, "h w"]] | None = None,
) -> _Segmentation:
    """Segment all frames; compare some with the answer to the mirrored frame.

    Args:
        frames: sRGB in [0, 1].
        network: to ask.
        known: its answers to the frames that are compared.
    """
    size, checked = _reduced(frames, REFINED_SIDE), {i: frames[i] for i in _spread(len(frames))}
    network, answers = consistent_answers(network, checked, size, known or {})
    agreement, asked = answers.agreement, answers.plain
    found = torch.stack(
        [asked[i] if i in asked else resized_answer(network, frames[i], size) for i in range(len(frames))]
    )
    if len(frames) == 1:
        found = (found + answers.mirrored[0]) / 2
    lab = _lab(frames, PARTS_SIDE)
    border = BorderDistances.of(lab)
    completed = _complete(lab, border, _weigh_colors(border, found))
    agreement = min(agreement, _agreement_of_completed(border, found > 0.5, completed > 0.5))
    if len(frames) == 1:
        closer = _weigh_colors(border, _closer(frames[0], completed[0], network)[None])
        completed = _complete(lab, border, (2 * completed + closer) / 3)
    return _Segmentation(completed, "network", agreement, True)


def _weigh_colors(border: BorderDistances, found: Float[Tensor, "t h2 w2"]) -> Float[Tensor, "t h2 w2"]:
    """Return a segmentation with the evidence of colors that the border of the frames lacks."""
    small = resize_planes(found[None], border.values.shape[1:])[0]
    evidence = torch.from_numpy(color_evidence(border, small.double().numpy()))
    odds = torch.logit(found.double(), UNSURE) + resize_planes(evidence[None], found.shape[1:])[0]
    return odds.sigmoid().to(found)


def _complete(
    lab: Float[ndarray, "t h w 3"], border: BorderDistances, found: Float[Tensor, "t h2 w2"]
) -> Float[Tensor, "t h2 w2"]:
    """Return a segmentation with the parts that it misses, found by colors that the border of the frames lacks."""
    segmented = resize_planes(found[None], lab.shape[1:3])[0].numpy() > 0.5
    segmented &= segmented.mean((1, 2), keepdims=True) >= MIN_AREA
    missing = torch.from_numpy(missing_parts(lab, border, segmented)).float()
    return torch.maximum(found, FUSED * resize_planes(missing[None], found.shape[1:])[0].clamp(0, 1))


def _agreement_of_completed(
    border: BorderDistances, found: Bool[Tensor, "t h2 w2"], completed: Bool[Tensor, "t h2 w2"]
) -> float:
    """Return the overlap (IoU) of a completed segmentation with a second method, in the frame in which it is smallest.

    The second method is the network, or the colors that the border lacks where these overlap more. Colors count only
    in frames where the network found something: elsewhere the completed segmentation is theirs alone.

    Args:
        border: of the frames.
        found: segmentation by the network.
        completed: with evidence of colors and missing parts.
    """
    overlaps = []
    for frame, (one, other) in enumerate(zip(found, completed, strict=True)):
        value = overlap(one, other)
        if value < AGREED and one.float().mean() >= MIN_AREA:
            unlike = torch.from_numpy(border.unlike(frame)).float()
            by_color = resize_planes(unlike[None, None], other.shape)[0, 0] > 0.5
            value = max(value, overlap(by_color, other))
        overlaps.append(value)
    return min(overlaps)


def _closer(
    frame: Float[Tensor, "h w 3"], found: Float[Tensor, "h2 w2"], network: Segmentation
) -> Float[Tensor, "h2 w2"]:
    """Return a segmentation whose square around the subject comes from a picture of that square alone."""
    rows, columns = (np.flatnonzero((found > CROP_SURE).any(axis).numpy()) for axis in (1, 0))
    if not len(rows):
        return found
    side = max(np.ptp(rows), np.ptp(columns)) + 1
    spans = []
    for places, length in ((rows, found.shape[0]), (columns, found.shape[1])):
        size = min(length, round(side * (1 + 2 * CROP_MARGIN)))
        first = min(max(0, (places[0] + places[-1] + 1 - size) // 2), length - size)
        spans.append(slice(first, first + size))
    window = (spans[0], spans[1])
    scale = frame.shape[0] / found.shape[0], frame.shape[1] / found.shape[1]
    large = tuple(slice(round(s.start * k), round(s.stop * k)) for s, k in zip(spans, scale, strict=True))
    answer = network.probability(frame[large])
    closer = found.clone()
    closer[window] = resize_planes(answer[None, None], tuple(closer[window].shape))[0, 0]
    return closer


def _refine(frames: Float[Tensor, "t h w 3"], probability: Float[Tensor, "t h2 w2"]) -> Float[Tensor, "t h w"]:
    """Refine a segmentation by color models and by the edges of the frames, up to their full size."""
    current, trusted = probability, _colors_tell(frames, probability)
    sure = SURE[trusted]
    for left in reversed(range(ROUNDS[trusted])):
        side = COLORS_SIDE if left else REFINED_SIDE
        size = _reduced(frames, side)
        lab, small = _lab(frames, side, blur=0), _resized(frames, torch.empty(0, *size)).cpu().numpy()
        prior = resize_planes(probability[None], size)[0].double().numpy()
        odds = _color_odds(lab, resize_planes(current[None], size)[0])
        mixed = expit((1 - COLOR_SHARE) * logit(prior.clip(sure, 1 - sure)) + COLOR_SHARE * odds)
        targets = torch.from_numpy(small) if left else frames.cpu()
        radius = max(2, round(FILTER_RADIUS * max(size)))
        filtered = [
            guide_to_edges(values, guide, target, radius, FILTER_EPS)
            for values, guide, target in zip(mixed, small, targets, strict=True)
        ]
        current = torch.stack(filtered).clamp(0, 1)
    likelihood = average_still_pixels(current, frames.cpu())
    alpha = (0.5 + STEEPNESS * (likelihood - 0.5)).clamp(0, 1)
    large = resize_planes(probability[None], alpha.shape[1:])[0]
    reach = 2 * max(2, round(FILTER_RADIUS * max(alpha.shape[1:])))
    whole = [_without_false_holes(a.numpy(), p.cpu().numpy() > 0.5, reach) for a, p in zip(alpha, large, strict=True)]
    return torch.from_numpy(np.stack(whole)).to(frames)


def _colors_tell(frames: Float[Tensor, "t h w 3"], probability: Float[Tensor, "t h2 w2"]) -> bool:
    """Return True if colors tell the segmented subject from its background.

    Where they do not, alternating with them drifts away from the segmentation.
    """
    found = resize_planes(probability[None], _reduced(frames, COLORS_SIDE))[0].double().numpy().clip(0, 1)
    by_color = expit(_color_odds(_lab(frames, COLORS_SIDE, blur=0), torch.from_numpy(found)))
    shares = (float(np.average(one, weights=w + 1e-9)) for one, w in ((by_color, found), (1 - by_color, 1 - found)))
    return sum(shares) / 2 >= TELLING


def _color_odds(lab: Float[ndarray, "t h w 3"], estimate: Float[Tensor, "t h w"]) -> Float[ndarray, "t h w"]:
    colors, likely = lab.reshape(-1, 3).astype(np.float64), estimate.double().numpy().ravel().clip(0, 1)
    return foreground_log_odds(colors, likely).reshape(estimate.shape)


def _without_false_holes(
    alpha: Float[ndarray, "h w"], segmented: Bool[ndarray, "h w"], reach: int
) -> Float[ndarray, "h w"]:
    """Remove specks and parts outside of the segmentation; fill holes that it and the outline enclose.

    Highlights are such holes; objects of the subject's colors elsewhere in a picture are such parts.

    Args:
        alpha: refined by colors alone.
        segmented: mask of the segmentation.
        reach: distance from the outline from which alpha is solid, pixels.
    """
    mask = _parts(alpha > 0.5, PART, segmented)
    filled = mask | (ndimage.binary_fill_holes(mask) & segmented)
    deep = ndimage.binary_erosion(filled, iterations=reach, border_value=1) & segmented
    solid = (filled & ~mask) | deep
    return np.where(solid, np.ones_like(alpha), alpha * ndimage.binary_dilation(mask, iterations=2))


def _lab(frames: Float[Tensor, "t h w 3"], longest: int, blur: float = 0.6) -> Float[ndarray, "t h2 w2 3"]:
    """Convert frames to CIE Lab, downscaled to a longest side and slightly blurred against pixel noise."""
    size = _reduced(frames, longest)
    lab = np.empty((len(frames), *size, 3), np.float32)
    for i, frame in enumerate(frames):
        small = frame.permute(2, 0, 1)[None]
        if size != tuple(frames.shape[1:3]):
            small = resize_planes(small, size)
        converted = rgb2lab(small[0].permute(1, 2, 0).cpu().numpy())
        lab[i] = ndimage.gaussian_filter(converted, (blur, blur, 0)) if blur else converted
    return lab


def _reduced(frames: Float[Tensor, "t h w 3"], longest: int) -> tuple[int, int]:
    """Return height and width with a longest side of at most `longest` pixels."""
    height, width = frames.shape[1:3]
    scale = min(1.0, longest / max(height, width))
    return (height, width) if scale == 1 else (max(8, round(height * scale)), max(8, round(width * scale)))


def _resized(frames: Float[Tensor, "t h w 3"], like: Float[Tensor, "n h2 w2"]) -> Float[Tensor, "t h2 w2 3"]:
    size = tuple(like.shape[1:])
    if size == tuple(frames.shape[1:3]):
        return frames
    return torch.cat([resize_planes(frame.permute(2, 0, 1)[None], size).permute(0, 2, 3, 1) for frame in frames])


def _spread(count: int) -> list[int]:
    """Return the indices of the checked frames."""
    return sorted({round(i) for i in np.linspace(0, count - 1, min(count, CHECKED_FRAMES))})


def _parts(
    mask: Bool[ndarray, "h w"], min_share: float, touched: Bool[ndarray, "h w"] | None = None
) -> Bool[ndarray, "h w"]:
    """Keep the connected parts of at least this area relative to the largest one, and of them those that are touched.

    Args:
        mask: of all parts.
        min_share: minimum area relative to the largest part.
        touched: pixels of which a part has one or more.
    """
    labels, count = ndimage.label(mask, np.ones((3, 3)))
    if count == 0:
        return mask
    areas = ndimage.sum_labels(mask, labels, np.arange(1, count + 1))
    large = 1 + np.flatnonzero(areas >= max(4, min_share * areas.max()))
    return np.isin(labels, large if touched is None else np.intersect1d(large, labels[touched]))


def _check(mask: Bool[ndarray, "h w"]) -> None:
    share = float(mask.mean())
    if share < MIN_AREA:
        found = "nothing stands out" if share == 0 else f"the foreground covers {share:.2%} of the picture"
        raise BadInput(f"no subject found: {found}, a subject must cover at least {MIN_AREA:.1%}; {ADVICE}")
    touched = float(mask[border_ring(*mask.shape)].mean())
    if share > MAX_AREA or touched > MAX_BORDER:
        raise BadInput(
            f"no subject found: the foreground covers {share:.0%} of the picture and {touched:.0%} of its border, at "
            f"most {MAX_AREA:.0%} and {MAX_BORDER:.0%} are allowed; {ADVICE}"
        )
