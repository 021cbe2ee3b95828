"""Visual hull of known views, rounded where few views leave corners, as a field on a grid.

A silhouette excludes all points that it does not contain (Laurentini 1994). The hull of a few silhouettes has corners
that no view shows: two orthogonal ones leave a square of a disc. Therefore the places of a point in the silhouettes,
0 on the medial axis and 1 on the outline, are bounded together by a superellipse. Upright views share the height of a
point; so that it does not count in each of them, the place is 0 in the middle of a row, too.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64
from scipy import ndimage
from torch import Tensor
from torch.nn.functional import grid_sample

from dg4d_lib.errors import BadInput
from dg4d_lib.inflation.heights import local_radius, outline_distance
from dg4d_lib.inflation.mask import subject_mask
from dg4d_lib.visual_hull.known import KnownView, angle_deg

REACH = 1.2  # world units: half side of the box that is searched
COARSE = 48  # cells of a side of that box
OUTSIDE = -1.0  # world units: margin of points that no picture shows
TRUNCATION = 2.0  # cells: margins are clipped there
CHUNK = 1 << 18  # points at a time
ROUND_EXPONENT = 2.5  # of the superellipse of two orthogonal views; 2 is an ellipse
MANY = 6  # views; with more, the errors of all add up, and thin parts get lost without `SLACK`
SLACK = 0.5  # pixels by which thin parts of a silhouette are wider
THIN = 3.0  # pixels: radius of thin parts
SMALLEST_RADIUS = 1.5  # pixels: thinner parts are not rounded
UPRIGHT_DEG = 30.0  # largest elevation of a view whose rows are those of other views, nearly


@dataclass(frozen=True)
class Volume:
    """Signed field on a grid: positive inside, world units, truncated.

    Attributes:
        values: by x, y, z.
        low: world place of the first value.
        step: distance of neighbors, world units.
    """

    values: Float32[np.ndarray, "x y z"]
    low: Float32[np.ndarray, " 3"]
    step: float


@dataclass(frozen=True)
class _Silhouette:
    """Planes of one view: signed distance to the outline in pixels, and place between middle and outline."""

    view: KnownView
    planes: Float[Tensor, "1 2 h w"]
    viewmat: Float[Tensor, "4 4"]
    weight: float

    def sample(self, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Return the margin of points inside of the silhouette, world units, and their place in it."""
        camera = self.view.camera
        seen = points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]
        depth = seen[:, 2].clamp(min=1e-3)
        at = seen[:, :2] / depth[:, None] * (2 * camera.focal / camera.height)
        distance, place = grid_sample(self.planes, at[None, None], align_corners=False)[0, :, 0]
        inside = (at.abs() < 1).all(-1)
        return torch.where(inside, distance * depth / camera.focal, OUTSIDE), place


def hull(
    views: Sequence[KnownView],
    cells: int,
    exponent: float = ROUND_EXPONENT,
    reach: float = 0.0,
    lenience: float = 0.0,
) -> Volume:
    """Carve the hull of views out of space.

    Args:
        views: of one moment, at least one.
        cells: along the longest side of the subject.
        exponent: of the superellipse that two orthogonal views get; more views get a larger one, so that corners stay.
        reach: distance outside of the hull to which the field is exact, world units; at least `TRUNCATION` cells.
        lenience: cells by which the silhouettes of unreliable views, with weights below 1, are wider.

    Raises:
        BadInput: a picture shows no subject, or no place is inside of all silhouettes.
    """
    silhouettes = _silhouettes(views)
    power = exponent * max(1.0, _directions(views) / 2)
    low, high = _bounds(silhouettes)
    step = float((high - low).max()) / cells
    low, high = low - reach - 2 * step, high + reach + 2 * step
    axes = [torch.arange(float(a), float(b) + step, step) for a, b in zip(low, high, strict=True)]
    points = torch.cartesian_prod(*axes)
    lowest = -max(reach, TRUNCATION * step)
    field = torch.cat([_margins(silhouettes, part, step, power, lowest, lenience) for part in points.split(CHUNK)])
    values = field.reshape([len(axis) for axis in axes]).numpy()
    if not (values > 0).any():
        raise BadInput(_apart(views))
    return Volume(values, low.numpy(), step)


def _apart(views: Sequence[KnownView]) -> str:
    named = ", ".join(f"azimuth {view.camera.azimuth_deg:g}" for view in views)
    return (
        f"the silhouettes of the views ({named}) have no common shape; check that all show the same subject, in the "
        "same size, and their azimuths (90 is the subject's left side, seen on the picture's right)"
    )


def _silhouettes(views: Sequence[KnownView]) -> list[_Silhouette]:
    share = 2 / max(2, len(views))
    return [
        _Silhouette(
            view,
            _planes(view, SLACK if len(views) > MANY else 0.0),
            view.camera.viewmat().float(),
            share * (1 if len(views) > 1 else 0),
        )
        for view in views
    ]


def _directions(views: Sequence[KnownView]) -> int:
    """Return the number of views in clearly different directions, counting opposite ones as one."""
    kept: list[KnownView] = []
    for view in views:
        gaps = [angle_deg(view.camera, other.camera) for other in kept]
        if all(min(gap, 180 - gap) > 10 for gap in gaps):
            kept.append(view)
    return len(kept)


def _planes(view: KnownView, slack: float) -> Float[Tensor, "1 2 h w"]:
    """Return the signed distance to the outline, exact to parts of a pixel, and the place in the silhouette."""
    mask, alpha = subject_mask(view.cutout[..., 3].double().cpu().numpy())
    outside = ndimage.distance_transform_edt(~mask)
    within = outline_distance(mask)
    signed = np.where(mask, within - 0.5, 0.5 - outside)
    edge = np.abs(signed) < 1
    signed = np.where(edge, alpha.clip(0, 1) - 0.5, signed)
    radius = np.maximum(local_radius(mask, within), SMALLEST_RADIUS)
    widest = ndimage.maximum_filter(radius * mask, 3)  # also right beside the outline
    thin = (widest > 0) & (widest < THIN)
    place = np.where(mask & (radius > SMALLEST_RADIUS), 1 - (within / radius).clip(0, 1), 0.0)
    if abs(view.camera.elevation_deg) <= UPRIGHT_DEG:
        place = np.minimum(place, _places_in_rows(mask))
    return torch.from_numpy(np.stack([signed + slack * thin, place])[None]).float()


def _places_in_rows(mask: Bool[np.ndarray, "h w"]) -> Float64[np.ndarray, "h w"]:
    """Return the place of every pixel in its run of a row: 0 in the middle, 1 at the ends."""
    width = mask.shape[1]
    columns = np.arange(width)
    first = np.maximum.accumulate(np.where(mask, -1, columns), axis=1)  # last column outside on the left
    after = np.minimum.accumulate(np.where(mask, width, columns)[:, ::-1], axis=1)[:, ::-1]
    return np.where(mask, np.abs(2 * columns - first - after) / np.maximum(after - first - 1, 1), 0.0)


def _bounds(silhouettes: Sequence[_Silhouette]) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
    """Return the corners of the box around the hull."""
    axis = torch.linspace(-REACH, REACH, COARSE + 1)
    step = 2 * REACH / COARSE
    points = torch.cartesian_prod(axis, axis, axis)
    for silhouette in silhouettes:
        points = points[silhouette.sample(points)[0] > -step]
    if not len(points):
        raise BadInput(_apart([silhouette.view for silhouette in silhouettes]))
    return points.amin(0) - step, points.amax(0) + step


def _margins(
    silhouettes: Sequence[_Silhouette], points: Float[Tensor, "n 3"], step: float, power: float, lowest: float,
    lenience: float,
) -> Float[Tensor, " n"]:  # fmt: skip
    """Return the truncated field of points; each view sees those that the earlier ones left."""
    limit = TRUNCATION * step
    field = points.new_full((len(points),), limit)
    places = points.new_zeros(len(points))
    left = torch.arange(len(points))
    for silhouette in silhouettes:
        margin, place = silhouette.sample(points[left])
        margin += lenience * step * (silhouette.view.weight < 1)
        field[left] = torch.minimum(field[left], margin)
        places[left] += silhouette.weight * place**power
        left = left[field[left] > lowest]
    rounded = (1 - places.clamp(min=1e-6) ** (1 / power)) * limit * 4
    return torch.minimum(field, rounded).clamp(lowest, limit)


def margins_of(views: Sequence[KnownView], points: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Return the smallest margin of points inside of the silhouettes of views, world units."""
    silhouettes = _silhouettes(views)
    parts = [[silhouette.sample(part)[0] for silhouette in silhouettes] for part in points.split(CHUNK)]
    return torch.cat([torch.stack(margins).amin(0) for margins in parts])
