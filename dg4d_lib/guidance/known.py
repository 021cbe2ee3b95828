"""Shapes of a subject from known views: the colored visual hull at known frames, another prior's shapes elsewhere."""

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.guidance.interface import GuidanceView, SubjectShapes
from dg4d_lib.images import over_background
from dg4d_lib.inflation.render import render_surface
from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.visual_hull.known import KnownView
from dg4d_lib.visual_hull.probable import Predict
from dg4d_lib.visual_hull.shape import known_volume, leaves_doubt
from dg4d_lib.visual_hull.surface import colored_surface


class KnownShapes:
    """Shapes per frame: from known views where a frame has some, else a guess."""

    def __init__(
        self,
        guess: SubjectShapes,
        known: Mapping[int, Sequence[KnownView]],
        predict: Predict | None = None,
        surfaces: Mapping[int, InflatedSurface] | None = None,
    ) -> None:
        """Store the views.

        Args:
            guess: shapes of frames without known views.
            known: views by frame, the input view first.
            predict: predicts the shape behind each of their pictures; see `known_volume`.
            surfaces: of some of these frames, where they are made already.
        """
        self._guess, self._predict = guess, predict
        self._known = {frame: tuple(views) for frame, views in known.items()}
        self._surfaces = dict(surfaces or {})

    @property
    def guess(self) -> SubjectShapes:
        """Shapes of the other frames."""
        return self._guess

    @property
    def has_predictions(self) -> bool:
        """True if predicted shapes behind the pictures are used at some frame."""
        return self._predict is not None and any(leaves_doubt(views) for views in self._known.values())

    @property
    def frames(self) -> tuple[int, ...]:
        """Frames with known views."""
        return tuple(sorted(self._known))

    def surface(self, frame: int) -> InflatedSurface:
        """Return the closed, colored surface of a frame.

        Raises:
            BadInput: there is no such frame, or its views contradict each other.
        """
        if frame not in self._known:
            return self._guess.surface(frame)
        if frame not in self._surfaces:
            views = self._known[frame]
            self._surfaces[frame] = colored_surface(known_volume(views, self._predict), views)
        return self._surfaces[frame]

    def clean(self, views: Sequence[GuidanceView]) -> tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 1"]]:
        """Return expected color over white and expected alpha of views of one size, in [0, 1].

        Raises:
            BadInput: no views, views of different sizes, or a frame that is not there.
        """
        places = [i for i, view in enumerate(views) if view.frame in self._known]
        others = [i for i in range(len(views)) if i not in set(places)]
        if not places:
            return self._guess.clean(views)
        color, alpha = render_surface([self.surface(views[i].frame) for i in places], [views[i].camera for i in places])
        both = torch.cat([over_background(color, alpha, 1.0), alpha], -1)
        if others:
            guessed = torch.cat(self._guess.clean([views[i] for i in others]), -1)
            both = torch.cat([both, guessed])[torch.argsort(torch.tensor([*places, *others]))]
        return both[..., :3], both[..., 3:]
