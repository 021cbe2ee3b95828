"""Answers of a segmentation network to frames and to mirrored ones; negatives count where the two contradict."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.images import resize_planes
from dg4d_lib.video.segmentation_network import BORDER_MARGIN, MIN_AREA, Segmentation, border_contact, overlap

CONTRADICTORY = 0.7  # overlap (IoU) with the answer to the mirrored frame below which negatives count, too
LEAST_CERTAIN = 0.01  # bound of probabilities whose log-odds are averaged


@dataclass(frozen=True)
class Answers:
    """Probabilities of the subject in some of the frames.

    Attributes:
        plain: by the number of the frame.
        mirrored: of the mirrored frames, mirrored back.
    """

    plain: Mapping[int, Float[Tensor, "h w"]]
    mirrored: Mapping[int, Float[Tensor, "h w"]]

    @property
    def agreement(self) -> float:
        """Overlap (IoU) of both in the frame in which it is smallest."""
        pairs = zip(self.plain.values(), self.mirrored.values(), strict=True)
        return min(overlap(one > 0.5, other > 0.5) for one, other in pairs)

    @property
    def trust(self) -> float:
        """Agreement, or 0 if there is no subject in any frame: empty answers agree, but tell nothing."""
        shares = [float((one > 0.5).float().mean()) for one in self.plain.values()]
        return self.agreement if max(shares) >= MIN_AREA else 0.0

    @property
    def border_contact(self) -> float:
        """Share of the border of the frames that the subject covers."""
        return border_contact(torch.stack([*self.plain.values(), *self.mirrored.values()]) > 0.5)


@dataclass(frozen=True)
class WithNegatives:
    """Network whose answer is the mean of its log-odds for a picture and for the negative of the picture.

    Attributes:
        network: that answers both.
        share: weight of the negative, in [0, 1].
    """

    network: Segmentation
    share: float

    def probability(self, picture: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
        """Return the probability of every pixel of an sRGB picture in [0, 1]."""
        return _mean(self.network.probability(picture), self.network.probability(1 - picture), self.share)


def consistent_answers(
    network: Segmentation,
    frames: Mapping[int, Float[Tensor, "h w 3"]],
    size: tuple[int, int],
    known: Mapping[int, Float[Tensor, "h w"]],
) -> tuple[Segmentation, Answers]:
    """Ask a network about frames and mirrored frames, and about their negatives if its answers contradict each other.

    An answer counts by the square of its agreement with the answer to the mirrored frame: a network that is not sure
    of a subject changes its mind when it sees the mirror image. Negatives do not count if their subject touches more of
    the border.

    Args:
        network: to ask.
        frames: sRGB in [0, 1], by number.
        size: of the answers, height and width.
        known: its answers to some of the frames.

    Returns:
        The network to ask about all other frames, and its answers.
    """
    answers = _ask(network.probability, frames, size, known)
    if answers.trust >= CONTRADICTORY:
        return network, answers
    other = _ask(lambda picture: network.probability(1 - picture), frames, size, {})
    if not other.trust or other.border_contact > answers.border_contact + BORDER_MARGIN:
        return network, answers
    share = other.trust**2 / (answers.trust**2 + other.trust**2)
    mixed = Answers(
        {i: _mean(answers.plain[i], other.plain[i], share) for i in frames},
        {i: _mean(answers.mirrored[i], other.mirrored[i], share) for i in frames},
    )
    return WithNegatives(network, share), mixed


def resized_answer(
    network: Segmentation, frame: Float[Tensor, "h w 3"], size: tuple[int, int]
) -> Float[Tensor, "h2 w2"]:
    """Return a network's answer to a frame, in another size: height and width."""
    return _resized(network.probability(frame), size)


def _ask(
    probability: Callable[[Tensor], Tensor],
    frames: Mapping[int, Float[Tensor, "h w 3"]],
    size: tuple[int, int],
    known: Mapping[int, Float[Tensor, "h w"]],
) -> Answers:
    plain = {i: _resized(known[i] if i in known else probability(frame), size) for i, frame in frames.items()}
    return Answers(plain, {i: _resized(probability(frame.flip(1)).flip(1), size) for i, frame in frames.items()})


def _mean(one: Float[Tensor, "h w"], other: Float[Tensor, "h w"], share: float) -> Float[Tensor, "h w"]:
    return torch.lerp(torch.logit(one, LEAST_CERTAIN), torch.logit(other, LEAST_CERTAIN), share).sigmoid()


def _resized(answer: Float[Tensor, "h w"], size: tuple[int, int]) -> Float[Tensor, "h2 w2"]:
    return resize_planes(answer[None, None], size)[0, 0]
