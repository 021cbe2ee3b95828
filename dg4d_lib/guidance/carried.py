"""Shapes of later frames: blend of the prediction for the frame and the first frame's shape, warped by optical flow.

Every pixel of a later frame takes along what lies behind it at the first frame. Depths stay, which is exact for motions
in the image plane, or change as motions in a known upright plane do. Where the video is followed badly, the frame's own
guess is left.
"""

import math
import threading
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.cameras.orbit import RADIUS
from dg4d_lib.shape_prior.field import Fields, ShapeField, bounded_logits, premultiplied
from dg4d_lib.shape_prior.frustum import TAN_HALF_FOV
from dg4d_lib.shape_prior.raymarch import CELL
from dg4d_lib.video.first_frame import Correspondence, match_first_frame, strain

EDGE_ON = 0.1  # damps depths of motions in planes that are seen edge-on
MOST_STRAIN = 0.15  # strain of the picture at which the share of a predicted first frame falls to 1/e


class CarriedFields:
    """Guess per frame, mixed with the field of the first frame as the video carries it."""

    def __init__(
        self,
        guess: Fields,
        first: ShapeField | None,
        cutouts: Sequence[Float[Tensor, "h w 4"]],
        most_strain: float = math.inf,
        normal: Float[np.ndarray, " 3"] | None = None,
    ) -> None:
        """Store the fields; the video is followed as far as frames are asked for.

        Args:
            guess: fields of all frames.
            first: known field of the first frame; None: its guess.
            cutouts: one per frame: square, straight alpha, color and alpha in [0, 1].
            most_strain: of the picture, at which the share of the first frame falls to 1/e. Parts that turn in depth
                are foreshortened; a first frame that is a guess too says no more of them than the own guess.
            normal: horizontal unit vector across the plane in which parts move; None: that of the image.

        Raises:
            BadInput: the first frame is a guess and shows no subject.
        """
        self._guess, self._most_strain, self._normal = guess, most_strain, normal
        self._first, self._first_is_guess = (guess.predict(0), True) if first is None else (first, False)
        self._upcoming = match_first_frame([premultiplied(cutout) for cutout in cutouts])
        self._matches: list[Correspondence] = []
        self._matching = threading.Lock()

    def __len__(self) -> int:
        return len(self._guess)

    def predict(self, frame: int) -> ShapeField:
        """Return the field of a frame, its log-odds and hidden colors mixed.

        Raises:
            BadInput: the frame shows no subject.
        """
        own = self._first if self._first_is_guess and frame == 0 else self._guess.predict(frame)
        match = self._match(frame)
        carried, share = carry(self._first, match, self._normal), match.trust
        if math.isfinite(self._most_strain):
            share = share * torch.exp(-(strain(match, own.mask) / self._most_strain).square())
        logits = own.logits + share[..., None] * (carried.logits - own.logits)
        hidden = own.hidden + share[..., None, None] * (carried.hidden - own.hidden)
        logits = bounded_logits(logits, own.mask)
        return replace(own, logits=logits, hidden=hidden, generosity=self._first.generosity)

    def _match(self, frame: int) -> Correspondence:
        """Return the correspondence of a frame; threads that ask for several frames follow the video once."""
        with self._matching:
            while len(self._matches) <= frame:
                self._matches.append(next(self._upcoming))
        return self._matches[frame]


def carry(field: ShapeField, match: Correspondence, normal: Float[np.ndarray, " 3"] | None = None) -> ShapeField:
    """Return the field of the first frame at another one; the picture and its mask stay.

    Args:
        field: of the first frame.
        match: of the other one.
        normal: horizontal unit vector across the plane in which parts move; None: they keep their depths.
    """
    planes = torch.cat([field.logits[..., None], field.hidden], -1).permute(2, 3, 0, 1)  # depth c h w
    moved = match.warp(planes.flatten(0, 1)).unflatten(0, planes.shape[:2])
    if normal is not None:
        moved = _deepened(moved, match, normal)
    logits, hidden = moved.permute(2, 3, 0, 1).split([1, 3], -1)
    return replace(field, logits=logits[..., 0], hidden=hidden)


def _deepened(
    planes: Float[Tensor, "d c h w"], match: Correspondence, normal: Float[np.ndarray, " 3"]
) -> Float[Tensor, "d c h w"]:
    """Return planes by depth, moved in depth as far as a sideways motion in an upright plane does."""
    depths, width = len(planes), planes.shape[-1]
    across, _, along = normal
    sideways = (torch.arange(width) - match.places[..., 1]) * (2 * RADIUS * TAN_HALF_FOV / width)
    nearer = -float(across * along / (along**2 + EDGE_ON)) * sideways
    cells = torch.arange(depths)[:, None, None] + nearer / CELL
    low = cells.floor().clamp(0, depths - 2).long()
    share = (cells - low).clamp(0, 1)[:, None]
    low = low[:, None].expand_as(planes)
    return planes.gather(0, low) * (1 - share) + planes.gather(0, low + 1) * share
