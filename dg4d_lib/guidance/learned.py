"""Views of a subject by the shape prior: of its most probable surface, or averages over all possible shapes."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.guidance.geometric import surface_views
from dg4d_lib.guidance.interface import GuidanceView, check_frame, check_views
from dg4d_lib.images import resize
from dg4d_lib.inflation.surface import InflatedSurface
from dg4d_lib.kernels.workers import run_parallel, torch_on_one_thread
from dg4d_lib.settings import LearnedPriorSettings
from dg4d_lib.shape_prior.expected import expected_volume
from dg4d_lib.shape_prior.field import Fields, ShapeField
from dg4d_lib.shape_prior.frustum import SIZE
from dg4d_lib.shape_prior.raymarch import ShapeVolume, render_volumes
from dg4d_lib.shape_prior.surface import decided_surface

COARSER = 2  # times fewer pixels of a side than the camera has: expected views are soft


class LearnedShapes:
    """Predicted shape per frame, each built when first asked for."""

    def __init__(self, fields: Fields, settings: LearnedPriorSettings) -> None:
        """Store the fields.

        Args:
            fields: of all frames.
            settings: uncertainty of the views.
        """
        self._fields, self._settings = fields, settings
        self._surfaces: dict[int, InflatedSurface] = {}
        self._volumes: dict[int, ShapeVolume] = {}
        self._inflated: dict[int, float] = {}
        self._last: tuple[int, ShapeField] | None = None  # one: a field has 17 MB

    @property
    def inflated_share(self) -> float:
        """Mean share of the inflation in the requested frames; 0 if none was requested."""
        return sum(self._inflated.values()) / max(1, len(self._inflated))

    def surface(self, frame: int) -> InflatedSurface:
        """Return the closed surface of a frame.

        Raises:
            BadInput: there is no such frame, or its picture shows no subject.
        """
        if frame not in self._surfaces:
            self._surfaces[frame] = decided_surface(self._field(frame))
        return self._surfaces[frame]

    def clean(self, views: Sequence[GuidanceView]) -> tuple[Float[Tensor, "b h w 3"], Float[Tensor, "b h w 1"]]:
        """Return color over white and alpha, in [0, 1].

        Args:
            views: b cameras of one size, each with its frame.

        Raises:
            BadInput: no views, views of different sizes, or a frame that is not there.
        """
        check_views(views, len(self._fields))
        if not self._settings.contrast:
            frames = dict.fromkeys(view.frame for view in views)
            with torch_on_one_thread():
                run_parallel([partial(self.surface, frame) for frame in frames if frame not in self._surfaces])
            surfaces = [self.surface(view.frame) for view in views]
            return surface_views(surfaces, [view.camera for view in views], SIZE, self._settings.depth_sigma)
        size = views[0].camera.height, views[0].camera.width
        coarse = _coarse(size)
        cameras = [replace(view.camera, height=coarse[0], width=coarse[1]) for view in views]
        color, alpha = render_volumes([self._volume(view.frame) for view in views], cameras)
        both = torch.cat([color + 1 - alpha, alpha], -1)
        both = resize(both, size, "bicubic").clamp(0, 1)
        return both[..., :3], both[..., 3:]

    def _volume(self, frame: int) -> ShapeVolume:
        if frame not in self._volumes:
            self._volumes[frame] = expected_volume(self._field(frame), self._settings.contrast)
        return self._volumes[frame]

    def _field(self, frame: int) -> ShapeField:
        check_frame(frame, len(self._fields))
        last = self._last
        if last is None or last[0] != frame:
            self._last = last = frame, self._fields.predict(frame)
        field = last[1]
        self._inflated[frame] = field.inflated_share
        return field


def _coarse(size: tuple[int, int]) -> tuple[int, int]:
    """Return the size at which a picture is rendered before it is enlarged."""
    factor = max(COARSER, -(-max(size) // SIZE))
    return max(1, size[0] // factor), max(1, size[1] // factor)
