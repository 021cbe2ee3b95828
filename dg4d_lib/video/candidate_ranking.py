"""Which of several driving videos is worth being made 3D, without a person looking.

Five questions, each answered by a number in [0, 1]:
  alive      share of the frames that show the subject and are not frozen
  whole      the subject stays inside the frame and keeps its area
  identity   the first frame is the input picture, and its colors stay
  motion     something happens
  steady     what happens goes on in the next frame instead of jumping back
The total is `alive` times the weighted mean of the others, so that nothing makes up for a broken video.
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
SIZE = 128  # pixels at which videos are compared
COARSE = 8  # pixels at which flicker is told: below the motion of edges from frame to frame
BINS = 6  # of a color histogram, per channel
SAME = 2e-4  # mean change of a picture below which it repeats the one before
LIVELY = 0.05  # mean change of the subject against the first frame that earns 63 % of `motion`
TOUCHED = 0.05  # share of the border, more than in the input, that costs all of `whole`
CALM, RESTLESS = 1.0, 1.9  # ratios of second to first differences: smooth motion, and noise
DARK = 0.4  # of the input's brightness, below which a subject is lost
MIN_GOOD_TOTAL = 0.7  # totals below are worth a warning


@dataclass(frozen=True)
class VideoScore:
    """How good a driving video is; see the module for the five numbers, all in [0, 1].

    Attributes:
        remarks: what is wrong, in words.
    """

    alive: float
    whole: float
    identity: float
    motion: float
    steady: float
    remarks: tuple[str, ...]

    @property
    def total(self) -> float:
        """In [0, 1]; 1 is best."""
        return self.alive * sum(weight * float(getattr(self, name)) for name, weight in WEIGHTS.items())

    @property
    def weakest(self) -> str:
        """The name of the lowest of the five numbers."""
        return min(("alive", *WEIGHTS), key=lambda name: float(getattr(self, name)))


@dataclass(frozen=True)
class Candidate:
    """One of the videos.

    Attributes:
        number: by which a user picks it, from 1.
        name: what made it, for people.
        video: itself.
        score: how good it is.
    """

    number: int
    name: str
    video: DrivingVideo
    score: VideoScore

    def row(self) -> dict[str, object]:
        """A line of the ranked table."""
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
    """The best first; equal ones in the order of their numbers."""
    return sorted(candidates, key=lambda candidate: (-candidate.score.total, candidate.number))


def score_video(video: DrivingVideo, subject: Float[Tensor, "h w 4"]) -> VideoScore:
    """Judge a video of a subject.

    Args:
        video: of two frames or more.
        subject: straight alpha, in [0, 1], of the video's size: what the first frame should show.
    """
    cutouts = _small(torch.cat([video.frames * video.alpha, video.alpha], -1).float(), SIZE)
    truth = _small(torch.cat([subject[..., :3] * subject[..., 3:], subject[..., 3:]], -1)[None].float(), SIZE)
    pictures, expected = _over_white(cutouts), _over_white(truth)
    shown, repeated = _shown(cutouts, truth), _repeated(pictures)
    alive = float((shown & ~repeated).float().mean())
    border, area = _border(cutouts, truth), _area(cutouts, truth)
    whole = (1 - min(1.0, border / TOUCHED)) * area
    likeness = float(ssim(pictures[:1], expected).clamp(0, 1))
    identity = 0.5 * likeness + 0.5 * _color_kept(cutouts, truth)
    motion = 1 - math.exp(-_motion(pictures, cutouts[..., 3]) / LIVELY)
    steady = min(1.0, max(0.0, (RESTLESS - _restlessness(pictures)) / (RESTLESS - CALM)))
    remarks = [
        (not bool(shown.all()), "frames are dark or empty"),
        (float(repeated.float().mean()) > 0.25, "the video is frozen for a while"),
        (border > 0.5 * TOUCHED, "the subject leaves the frame"),
        (area < 0.5, "the subject changes its size"),
        (identity < 0.6, "the subject does not look like the input"),
        (motion < 0.3, "hardly anything moves"),
        (steady < 0.4, "it flickers"),
    ]
    return VideoScore(alive, whole, identity, motion, steady, tuple(text for wrong, text in remarks if wrong))


def _small(pictures: Float[Tensor, "t h w c"], size: int) -> Float[Tensor, "t s s c"]:
    small = interpolate(pictures.movedim(-1, 1), (size, size), mode="area")
    return small.movedim(1, -1)


def _over_white(cutouts: Float[Tensor, "t s s 4"]) -> Float[Tensor, "t s s 3"]:
    """Of premultiplied colors."""
    return cutouts[..., :3] + 1 - cutouts[..., 3:]


def _shown(cutouts: Float[Tensor, "t s s 4"], truth: Float[Tensor, "1 s s 4"]) -> Tensor:
    """Frames in which a subject is, and not in the dark."""
    coverage, expected = cutouts[..., 3].mean((1, 2)), truth[..., 3].mean()
    light = cutouts[..., :3].mean((1, 2, 3)) / coverage.clamp_min(1e-6)
    return (coverage > 0.1 * expected) & (light > DARK * truth[..., :3].mean() / expected)


def _repeated(pictures: Float[Tensor, "t s s 3"]) -> Tensor:
    """Frames that are like both of their neighbors: motions that turn round show two equal frames, not three."""
    same = (pictures[1:] - pictures[:-1]).abs().mean((1, 2, 3)) < SAME
    return torch.cat([same[:1], same]) & torch.cat([same, same[-1:]])


def _border(cutouts: Float[Tensor, "t s s 4"], truth: Float[Tensor, "1 s s 4"]) -> float:
    """Share of the border that the subject covers in the worst frame, more than in the input."""
    covered = [
        torch.cat([alpha[:, 0], alpha[:, -1], alpha[:, :, 0], alpha[:, :, -1]], 1).mean(1)
        for alpha in (cutouts[..., 3], truth[..., 3])
    ]
    return float((covered[0] - covered[1]).amax().clamp_min(0))


def _area(cutouts: Float[Tensor, "t s s 4"], truth: Float[Tensor, "1 s s 4"]) -> float:
    """How much of its area the subject keeps in the worst frame; a change by less than a fifth costs nothing."""
    ratio = cutouts[..., 3].mean((1, 2)) / truth[..., 3].mean()
    return float((1.2 * torch.minimum(ratio, 1 / ratio.clamp_min(1e-6))).amin().clamp(0, 1))


def _color_kept(cutouts: Float[Tensor, "t s s 4"], truth: Float[Tensor, "1 s s 4"]) -> float:
    """What histograms of colors have in common with the input's, mean over the frames."""
    wanted = _histogram(truth[0])
    shared = torch.stack([torch.minimum(_histogram(frame), wanted).sum() for frame in cutouts])
    return float(shared.mean().clamp(max=1))  # sums of a histogram are rounded


def _histogram(cutout: Float[Tensor, "s s 4"]) -> Float[Tensor, " bins"]:
    """Of the subject's colors, weighted by alpha, soft between the bins; its sum is 1."""
    alpha = cutout[..., 3].flatten()
    place = (cutout[..., :3].reshape(-1, 3) / alpha[:, None].clamp_min(1e-6)).clamp(0, 1) * (BINS - 1)
    near = torch.relu(1 - (place[..., None] - torch.arange(BINS)).abs())  # pixel, channel, bin
    joint = torch.einsum("pi,pj,pk,p->ijk", *near.unbind(1), alpha)
    return joint.flatten() / alpha.sum().clamp_min(1e-6)


def _motion(pictures: Float[Tensor, "t s s 3"], alpha: Float[Tensor, "t s s"]) -> float:
    """Mean change of the subject's pixels against the first frame."""
    change = (pictures[1:] - pictures[:1]).abs().mean(-1)
    region = torch.maximum(alpha[1:], alpha[:1])
    return float(change.sum() / region.sum().clamp_min(1e-6))


def _restlessness(pictures: Float[Tensor, "t s s 3"]) -> float:
    """Second differences over first ones at a coarse size: small for smooth motion, 1.7 for noise, 2 for flashing."""
    if len(pictures) < 3:
        return 0.0
    coarse = _small(pictures, COARSE)
    first = (coarse[1:] - coarse[:-1]).abs().mean()
    second = (coarse[2:] - 2 * coarse[1:-1] + coarse[:-2]).abs().mean()
    return float(second / first.clamp_min(1e-6))
