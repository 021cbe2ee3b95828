"""Shapes of later frames: that of the first frame, carried along by the motion of the video, and the own guess.

Every pixel of a later frame takes along what lies behind it at the first frame, at the same depths: exact for motions
in the image plane. Where the video is followed badly, the frame's own guess is left.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.shape_prior.field import Fields, ShapeField, bounded_logits, premultiplied
from dg4d_lib.video.first_frame import Correspondence, match_first_frame, strain

MOST_STRAIN = 0.15  # of the picture, at which the share of a guessed first frame falls to 1/e


class CarriedFields:
    """Guess per frame, mixed with the field of the first frame as the video carries it."""

    def __init__(
        self,
        guess: Fields,
        first: ShapeField,
        cutouts: Sequence[Float[Tensor, "h w 4"]],
        most_strain: float = math.inf,
    ) -> None:
        """Follow the video.

        Args:
            guess: fields of all frames.
            first: field of the first frame.
            cutouts: one per frame: square, straight alpha, color and alpha in [0, 1].
            most_strain: of the picture, at which the share of the first frame falls to 1/e. Parts that turn in depth
                are foreshortened; a first frame that is a guess too says no more of them than the own guess.
        """
        self._guess, self._first, self._most_strain = guess, first, most_strain
        self._matches = match_first_frame([premultiplied(cutout) for cutout in cutouts])

    def __len__(self) -> int:
        return len(self._guess)

    def predict(self, frame: int) -> ShapeField:
        """Return the field of a frame, its log-odds and hidden colors mixed.

        Raises:
            BadInput: the frame shows no subject.
        """
        own, match = self._guess.predict(frame), self._matches[frame]
        carried, share = carry(self._first, match), match.trust
        if math.isfinite(self._most_strain):
            share = share * torch.exp(-(strain(match, own.mask) / self._most_strain).square())
        logits = own.logits + share[..., None] * (carried.logits - own.logits)
        hidden = own.hidden + share[..., None, None] * (carried.hidden - own.hidden)
        logits = bounded_logits(logits, own.mask)
        return replace(own, logits=logits, hidden=hidden, generosity=self._first.generosity)


def carry(field: ShapeField, match: Correspondence) -> ShapeField:
    """Return the field of the first frame at another one; the picture and its mask stay."""
    logits = match.warp(field.logits.permute(2, 0, 1)).permute(1, 2, 0)
    hidden = match.warp(field.hidden.flatten(2).permute(2, 0, 1)).permute(1, 2, 0)
    return replace(field, logits=logits, hidden=hidden.unflatten(2, field.hidden.shape[2:]))
