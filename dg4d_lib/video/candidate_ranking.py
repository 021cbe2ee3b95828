"""Automatic ranking of candidate driving videos.

Five scores in [0, 1]:
  alive      share of the frames that show the subject and are not frozen
  whole      the subject stays inside the frame and keeps its area
  identity   the first frame matches the input picture, and its colors persist
  motion     amount of motion
  steady     motion continues from frame to frame instead of flickering
The total is `alive` times the weighted mean of the others, so other scores cannot compensate for a broken video.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from dg4d_lib.metrics.ssim import ssim
from dg4d_lib.video.driving import DrivingVideo

WEIGHTS = {"whole": 0.3, "identity": 0.3, "motion": 0.2, "steady": 0.2}
SIZE = 128  # side of the compared frames, pixels
COARSE = 8  # side of the frames for flicker, pixels; edges that move between frames do not count at this size
BINS = 6  # color histogram bins per channel
SAME = 2e-4  # mean change of a frame below which it repeats the previous one
LIVELY = 0.05  # mean change of the subject from the first frame that scores 0.63 in `motion`
TOUCHED = 0.05  # share of the border, beyond the input's, at which `whole` is 0
CALM, RESTLESS = 1.0, 1.9  # ratio of second to first differences of smooth motion and of noise
DARK = 0.4  # brightness relative to the input below which the subject counts as lost
MIN_GOOD_TOTAL = 0.7  # the user is warned about lower totals


@dataclass(frozen=True)
class VideoScore:
    """Scores of a driving video in [0, 1], as defined in the module docstring.

    Attributes:
        remarks: defects in words.
    """

    alive: float
    whole: float
    identity: float
    motion: float
    steady: float
    remarks: tuple[str, ...]

    @property
    def total(self) -> float:
        """Total score in [0, 1]; 1 is best."""
        return self.alive * sum(weight * float(getattr(self, name)) for name, weight in WEIGHTS.items())

    @property
    def weakest(self) -> str:
        """Name of the lowest of the five scores."""
        return min(("alive", *WEIGHTS), key=lambda name: float(getattr(self, name)))


@dataclass(frozen=True)
class Candidate:
    """Candidate driving video with its score.

    Attributes:
        number: number by which a user picks it, from 1.
        name: motion or seed, shown to users.
        video: the video.
        score: its scores.
    """

    number: int
    name: str
    video: DrivingVideo
    score: VideoScore

    def row(self) -> dict[str, object]:
        """Return the candidate's row of the ranking."""
        parts = {name: round(float(getattr(self.score, name)), 4) for name in ("alive", *WEIGHTS)}
        total = round(self.score.total, 4)
        return {
            "number": self.number,
            "name": self.name,
            "total": total,
            **parts,
            "remarks": list(self.score.remarks),
        }


def rank_candidates(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Sort candidates by descending total; ties by number."""
    return sorted(candidates, key=lambda candidate: (-candidate.score.total, candidate.number))


def score_video(video: DrivingVideo, subject: Float[Tensor, "h w 4"]) -> VideoScore:
    """Score a driving video of a subject.

    Args:
        video: of two frames or more.
        subject: expected first frame, straight alpha, in [0, 1], of the video's size.
    """
    cutouts = _resize(torch.cat([video.frames * video.alpha, video.alpha], -1).float(), SIZE)
    reference = _resize(torch.cat([subject[..., :3] * subject[..., 3:], subject[..., 3:]], -1)[None].float(), SIZE)
    pictures, expected = _over_white(cutouts), _over_white(reference)
    shown, repeated = _shown(cutouts, reference), _repeated(pictures)
    alive = float((shown & ~repeated).float().mean())
    border, area = _border(cutouts, reference), _area(cutouts, reference)
    whole = (1 - min(1.0, border / TOUCHED)) * area
    first_ssim = float(ssim(pictures[:1], expected).clamp(0, 1))
    identity = 0.5 * first_ssim + 0.5 * _histogram_overlap(cutouts, reference)
    motion = 1 - math.exp(-_motion(pictures, cutouts[..., 3]) / LIVELY)
    steady = min(1.0, max(0.0, (RESTLESS - _jerkiness(pictures)) / (RESTLESS - CALM)))
    remarks = [
        (not bool(shown.all()), "frames are dark or empty"),
        (float(repeated.float().mean()) > 0.25, "the video is frozen for a while"),
        (border > 0.5 * TOUCHED, "the subject leaves the frame"),
        (area < 0.5, "the subject changes its size"),
        (identity < 0.6, "the subject does not look like the input"),
        (motion < 0.3, "hardly anything moves"),
        (steady < 0.4, "the video flickers"),
    ]
    return VideoScore(alive, whole, identity, motion, steady, tuple(text for wrong, text in remarks if wrong))


def _resize(pictures: Float[Tensor, "t h w c"], size: int) -> Float[Tensor, "t s s c"]:
    return interpolate(pictures.movedim(-1, 1), (size, size), mode="area").movedim(1, -1)


def _over_white(cutouts: Float[Tensor, "t s s 4"]) -> Float[Tensor, "t s s 3"]:
    """Composite premultiplied colors over white."""
    return cutouts[..., :3] + 1 - cutouts[..., 3:]


def _shown(cutouts: Float[Tensor, "t s s 4"], reference: Float[Tensor, "1 s s 4"]) -> Tensor:
    """Mark frames that show a subject bright enough to be seen."""
    area, expected = cutouts[..., 3].mean((1, 2)), reference[..., 3].mean()
    brightness = cutouts[..., :3].mean((1, 2, 3)) / area.clamp_min(1e-6)
    return (area > 0.1 * expected) & (brightness >= DARK * reference[..., :3].mean() / expected)


def _repeated(pictures: Float[Tensor, "t s s 3"]) -> Tensor:
    """Mark frames that equal both neighbors; motions that reverse repeat a frame once, not twice."""
    same = (pictures[1:] - pictures[:-1]).abs().mean((1, 2, 3)) < SAME
    return torch.cat([same[:1], same]) & torch.cat([same, same[-1:]])


def _border(cutouts: Float[Tensor, "t s s 4"], reference: Float[Tensor, "1 s s 4"]) -> float:
    """Return the share of the border that the subject covers in the worst frame, minus that of the input."""
    covered = [
        torch.cat([alpha[:, 0], alpha[:, -1], alpha[:, :, 0], alpha[:, :, -1]], 1).mean(1)
        for alpha in (cutouts[..., 3], reference[..., 3])
    ]
    return float((covered[0] - covered[1]).amax().clamp_min(0))


def _area(cutouts: Float[Tensor, "t s s 4"], reference: Float[Tensor, "1 s s 4"]) -> float:
    """Return the worst ratio of the subject's area to that of the input, in [0, 1]; changes below 20 % are free."""
    ratio = cutouts[..., 3].mean((1, 2)) / reference[..., 3].mean()
    return float((1.2 * torch.minimum(ratio, 1 / ratio.clamp_min(1e-6))).amin().clamp(0, 1))


def _histogram_overlap(cutouts: Float[Tensor, "t s s 4"], reference: Float[Tensor, "1 s s 4"]) -> float:
    """Return the mean intersection of the frames' color histograms with the input's."""
    expected = _histogram(reference[0])
    shared = torch.stack([torch.minimum(_histogram(frame), expected).sum() for frame in cutouts])
    return float(shared.mean().clamp(max=1))  # a histogram may sum to slightly more than 1


def _histogram(cutout: Float[Tensor, "s s 4"]) -> Float[Tensor, " bins"]:
    """Compute an alpha-weighted color histogram with linear interpolation between bins, sum 1."""
    alpha = cutout[..., 3].flatten()
    position = (cutout[..., :3].reshape(-1, 3) / alpha[:, None].clamp_min(1e-6)).clamp(0, 1) * (BINS - 1)
    weights = torch.relu(1 - (position[..., None] - torch.arange(BINS)).abs())  # pixel, channel, bin
    joint = torch.einsum("pi,pj,pk,p->ijk", *weights.unbind(1), alpha)
    return joint.flatten() / alpha.sum().clamp_min(1e-6)


def _motion(pictures: Float[Tensor, "t s s 3"], alpha: Float[Tensor, "t s s"]) -> float:
    """Return the mean change of the subject's pixels from the first frame."""
    change = (pictures[1:] - pictures[:1]).abs().mean(-1)
    region = torch.maximum(alpha[1:], alpha[:1])
    return float(change.sum() / region.sum().clamp_min(1e-6))


def _jerkiness(pictures: Float[Tensor, "t s s 3"]) -> float:
    """Return the ratio of second to first differences over time: small for smooth motion, 1.7 for noise, 2 for flashes.

    Frames are compared at the size `COARSE`.
    """
    if len(pictures) < 3:
        return 0.0
    coarse = _resize(pictures, COARSE)
    first = (coarse[1:] - coarse[:-1]).abs().mean()
    second = (coarse[2:] - 2 * coarse[1:-1] + coarse[:-2]).abs().mean()
    return float(second / first.clamp_min(1e-6))
