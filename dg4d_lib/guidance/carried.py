"""Fields of a subject whose first frame is known, carried to the later frames by the motion of the video.

Every pixel of a later frame takes along what lies behind it at the first frame, at the same depths: exact for motions
in the image plane. Where the video is followed badly, the frame's own guess is left.
"""

from collections.abc import Sequence
from dataclasses import replace

from jaxtyping import Float
from torch import Tensor

from dg4d_lib.shape_prior.field import Fields, ShapeField, bounded_logits, premultiplied
from dg4d_lib.video.first_frame import Correspondence, match_first_frame

MOST = 1.0  # share of the first frame where the video is followed perfectly


class CarriedFields:
    """Guess per frame, mixed with the known field of the first frame as the video carries it."""

    def __init__(self, guess: Fields, known: ShapeField, cutouts: Sequence[Float[Tensor, "h w 4"]]) -> None:
        """Follow the video.

        Args:
            guess: fields of all frames.
            known: field of the first frame.
            cutouts: one per frame: square, straight alpha, color and alpha in [0, 1].
        """
        self._guess, self._known = guess, known
        self._matches = match_first_frame([premultiplied(cutout) for cutout in cutouts])

    def __len__(self) -> int:
        return len(self._guess)

    def predict(self, frame: int) -> ShapeField:
        """Return the field of a frame, its log-odds and hidden colors mixed.

        Raises:
            BadInput: the frame shows no subject.
        """
        own, match = self._guess.predict(frame), self._matches[frame]
        carried = carry(self._known, match)
        trust = match.trust[..., None]
        logits = own.logits + MOST * trust * (carried.logits - own.logits)
        hidden = own.hidden + trust[..., None] * (carried.hidden - own.hidden)
        return replace(own, logits=bounded_logits(logits, own.mask), hidden=hidden)


def carry(field: ShapeField, match: Correspondence) -> ShapeField:
    """Return the field of the first frame at another one; the picture and its mask stay."""
    logits = match.warp(field.logits.permute(2, 0, 1)).permute(1, 2, 0)
    hidden = match.warp(field.hidden.flatten(2).permute(2, 0, 1)).permute(1, 2, 0)
    return replace(field, logits=logits, hidden=hidden.unflatten(2, field.hidden.shape[2:]))
