"""Placement and judgment of drawn views: scale, direction, and reliability by outlines and colors.

Models that draw other sides choose the distance of the camera themselves, some count azimuths the other way around, and
single pictures may show another subject. The input is right by definition; the pictures have to agree with it and with
each other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput
from dg4d_lib.visual_hull.adjusting import match_scale, scaling_between
from dg4d_lib.visual_hull.agreement import filled_shares, hull_alpha, smaller, turntable_score
from dg4d_lib.visual_hull.carve import hull
from dg4d_lib.visual_hull.known import KnownView
from dg4d_lib.visual_hull.surface import extract, observations

CELLS = 64
MIRRORED = 0.02  # by which the score of the other direction has to be better
OUTLINE_SPREAD = 0.25  # share of a silhouette outside of the hull of the others, beyond the median, that makes weight 0
DAMAGE_SPREAD = 0.08  # mean share of the other silhouettes that a view cuts away, likewise
COLOR_SPREAD = 0.25  # mean color difference from the other views, beyond the median, likewise
FEWEST = 50  # vertices of the hull by which colors are compared


@dataclass(frozen=True)
class Judgment:
    """Agreement of one view with the others.

    Attributes:
        outline: 1 if silhouettes agree as well as those of the other views do, 0 if they contradict each other.
        color: likewise for colors.
    """

    outline: float
    color: float

    @property
    def weight(self) -> float:
        """Reliability in [0, 1]."""
        return self.outline * self.color


def place_views(front: KnownView, views: Sequence[KnownView]) -> list[KnownView]:
    """Return views in the scale of the input: as they are, or matched if that agrees better.

    Matched views from elevation 0 show the height of the input; others get the bounding box of the hull of these.

    Args:
        front: input view.
        views: of the same subject, each centered in its frame.
    """
    matched = _matched(front, views)
    if any(view.cutout.shape != front.cutout.shape for view in views):
        return matched
    return max(([*views], matched), key=lambda ring: _agreement([front, *ring]))


def better_direction(front: KnownView, views: Sequence[KnownView]) -> tuple[list[KnownView], bool]:
    """Return views with the sign of their azimuths that fits the input clearly better; True if it is the other one."""
    reverse = [view.at(view.camera.elevation_deg, -view.camera.azimuth_deg % 360) for view in views]
    scores = [turntable_score([front, *ring]) for ring in (views, reverse)]
    mirrored = scores[1] > scores[0] + MIRRORED
    return (reverse if mirrored else [*views]), mirrored


def judge_views(front: KnownView, views: Sequence[KnownView]) -> list[Judgment]:
    """Return the agreement of every view with the input and the others.

    Errors of all views add up in the hull. Therefore views are compared with the median.
    """
    everyone = [smaller(front), *(smaller(view) for view in views)]
    if len(everyone) < 3:
        return [Judgment(1.0, 1.0) for _ in views]
    outside, damage = _outline_errors(everyone)
    colors = _color_errors(everyone)
    outlines = [
        _falling(out - median(outside), OUTLINE_SPREAD) * _falling(cut - median(damage), DAMAGE_SPREAD)
        for out, cut in zip(outside, damage, strict=True)
    ]
    tints = [_falling(error - median(colors), COLOR_SPREAD) for error in colors]
    return [Judgment(*pair) for pair in zip(outlines[1:], tints[1:], strict=True)]


def _matched(front: KnownView, views: Sequence[KnownView]) -> list[KnownView]:
    """Return views with the height of the input, or the bounding box of the hull of those that have it."""
    placed = {
        number: replace(view, cutout=match_scale(view.cutout, front.cutout, view.camera.azimuth_deg))
        for number, view in enumerate(views)
        if view.camera.elevation_deg == 0
    }
    level = [front, *placed.values()]
    for number, view in enumerate(views):
        if number not in placed:
            placed[number] = replace(view, cutout=_scaled_to_hull(view, level))
    size = front.camera.width
    return [
        replace(view, camera=replace(view.camera, width=size, height=size))
        for view in (placed[number] for number in range(len(views)))
    ]


def _scaled_to_hull(view: KnownView, others: Sequence[KnownView]) -> Float[Tensor, "s s 4"]:
    """Return the picture of a view with the bounding box that the hull of others has from its camera."""
    size = others[0].camera.width
    (expected,) = hull_alpha(others, [replace(view.camera, width=size, height=size)])
    if not bool((expected > 0.5).any()):
        return view.cutout
    reference = expected.expand(-1, -1, 4)
    return scaling_between(view.cutout, reference).apply(view.cutout, 0, size)


def _outline_errors(views: Sequence[KnownView]) -> tuple[list[float], list[float]]:
    """Return per view the share of its silhouette outside of the others' hull, and that which it cuts of theirs."""
    whole = _filled(views, views)
    outside, damage = [], []
    for index in range(len(views)):
        others = [*views[:index], *views[index + 1 :]]
        alone = _filled(others, views)
        kept = torch.arange(len(views)) != index
        outside.append(1 - float(alone[index]))
        damage.append(float((alone - whole)[kept].mean()))
    return outside, damage


def _filled(carving: Sequence[KnownView], views: Sequence[KnownView]) -> Float[Tensor, " k"]:
    """Return the share of every silhouette that the hull of some views fills.

    Blank views raise their number above `carve.MANY`, so that thin parts are widened: else true views of thin legs
    seem to contradict each other.
    """
    blank = [replace(view, cutout=torch.ones_like(view.cutout)) for view in views]
    return filled_shares([*carving, *blank], views)


def _agreement(views: Sequence[KnownView]) -> float:
    """Return the mean share of the silhouettes that the hull of all fills."""
    small = [smaller(view) for view in views]
    return float(_filled(small, small).mean())


def _color_errors(views: Sequence[KnownView]) -> list[float]:
    """Return the mean color difference of every view from the others, on the surface that both show."""
    try:
        volume = hull(views, CELLS)
    except BadInput:
        return [0.0] * len(views)
    vertices, faces = extract(volume)
    colors, weights = observations(vertices, faces, views, volume.step)
    found = []
    for index in range(len(views)):
        kept = torch.arange(len(views)) != index
        total = weights[kept].sum(0)
        mean = (weights[kept][..., None] * colors[kept]).sum(0) / total.clamp(min=1e-6)[:, None]
        shared = torch.minimum(weights[index], total)
        enough = int((shared > 0).sum()) >= FEWEST
        error = ((colors[index] - mean).abs().mean(-1) * shared).sum() / shared.sum().clamp(min=1e-6)
        found.append(float(error) if enough else 0.0)
    return found


def _falling(error: float, spread: float) -> float:
    """Return 1 for no error, falling to 0 at `spread`."""
    return max(0.0, min(1.0, 1 - error / spread))
