"""Agreement of known views: share of every silhouette that the common hull fills, and colors in several views."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.cameras.orbit import OrbitCamera
from dg4d_lib.errors import BadInput
from dg4d_lib.inflation.render import render_surface
from dg4d_lib.inflation.surface import InflatedSurface, resample
from dg4d_lib.visual_hull.carve import hull
from dg4d_lib.visual_hull.known import KnownView
from dg4d_lib.visual_hull.surface import blend, extract, observations

SIZE = 96  # pixels at which silhouettes are compared
CELLS = 64
SHARP = 20.0  # exponent of the superellipse: the hull itself
LEAST = 0.6  # share of the silhouettes: below, the views show different things
GAIN = 0.08  # of the others' mean share without a view, from which that view contradicts them
COLOR_WEIGHT = 1.0  # of the color difference in [0, 1] in a score of agreement


@dataclass(frozen=True)
class Agreement:
    """Agreement of views with each other.

    Attributes:
        filled: share of every silhouette that the hull of all fills.
        odd: index of the view that contradicts the others; None if there is none.
    """

    filled: tuple[float, ...]
    odd: int | None = None

    @property
    def mean(self) -> float:
        """Mean share."""
        return sum(self.filled) / len(self.filled)


def agreement(views: Sequence[KnownView]) -> Agreement:
    """Compare views of one moment, the input view first; it is never the odd one.

    With two views, the other one is odd if the hull leaves out too much.
    """
    small = [smaller(view) for view in views]
    filled = tuple(filled_shares(small, small).tolist())
    whole = Agreement(filled)
    if len(views) == 2:
        return replace(whole, odd=1 if whole.mean < LEAST else None)
    gains = {}
    for index in range(1, len(small)):
        others = small[:index] + small[index + 1 :]
        kept = [share for i, share in enumerate(filled) if i != index]
        gains[index] = float(filled_shares(others, others).mean()) - sum(kept) / len(kept)
    worst = max(gains, key=lambda index: gains[index])
    return replace(whole, odd=worst if gains[worst] > GAIN else None)


def turntable_score(views: Sequence[KnownView]) -> float:
    """Return the agreement of outlines and colors of a ring of views; higher is better.

    Parallel projections of a turning subject fit both directions of the turn, with near and far exchanged. Colors and
    perspective tell them apart.
    """
    small = [smaller(view) for view in views]
    try:
        volume = hull(small, CELLS, SHARP)
    except BadInput:
        return 0.0
    vertices, faces = extract(volume)
    colors, weights = observations(vertices, faces, small, volume.step)
    blended, total = blend(vertices, colors, weights)
    difference = ((colors - blended).abs().mean(-1) * weights).sum() / weights.sum().clamp(min=1e-6)
    filled = float(filled_shares(small, small).mean())
    return filled - COLOR_WEIGHT * float(difference) if bool(total.any()) else 0.0


def smaller(view: KnownView, size: int = SIZE) -> KnownView:
    """Return a view with fewer pixels."""
    return replace(view, cutout=resample(view.cutout, size), camera=replace(view.camera, width=size, height=size))


def hull_alpha(views: Sequence[KnownView], cameras: Sequence[OrbitCamera] | None = None) -> Float[Tensor, "k h w 1"]:
    """Return the silhouettes of the hull of views, from k cameras of one size; None: those of the views.

    Raises:
        BadInput: no place is inside of all silhouettes of the views.
    """
    vertices, faces = extract(hull(views, CELLS, SHARP))
    surface = InflatedSurface(vertices, faces, torch.zeros_like(vertices), torch.zeros(len(vertices), dtype=torch.bool))
    return render_surface(surface, [view.camera for view in views] if cameras is None else cameras)[1]


def filled_shares(carving: Sequence[KnownView], views: Sequence[KnownView]) -> Float[Tensor, " k"]:
    """Return the share of the silhouette of each of k views that the hull of some views fills; 0 without a hull."""
    try:
        alpha = hull_alpha(carving, [view.camera for view in views])
    except BadInput:
        return torch.zeros(len(views))
    given = torch.stack([view.cutout[..., 3:] for view in views]) > 0.5
    return ((alpha > 0.5) & given).sum((1, 2, 3)) / given.sum((1, 2, 3)).clamp(min=1)
