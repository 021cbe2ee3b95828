"""Scale, place and exposure of known views, adjusted to the input view."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample

from dg4d_lib.video.framing import bounding_box, extend_color, unpremultiply
from dg4d_lib.visual_hull.carve import hull
from dg4d_lib.visual_hull.known import KnownView
from dg4d_lib.visual_hull.surface import extract, observations

SAME = 0.01  # relative difference of scale that is left as it is
CELLS = 64
FEWEST = 30  # vertices that two views must share for a comparison of their exposure
STIFFNESS = 0.05  # of the gains at 1, relative to a pair that overlaps fully
LARGEST_GAIN = 2.0
UNSURE = 0.22  # mean logarithm of a gain that the hull's wrong places alone can cause: on equal exposures up to 0.21


@dataclass(frozen=True)
class Scaling:
    """Map from the square of the input to that of another picture.

    Attributes:
        factor: pixels of the picture per pixel of the input.
        right: shift of the picture's middle in the input's square, pixels, as the input's direction shows it.
        down: likewise, downwards.
    """

    factor: float
    right: float
    down: float

    @property
    def is_small(self) -> bool:
        """True if the pictures already have one scale and place."""
        return abs(self.factor - 1) < SAME and max(abs(self.right), abs(self.down)) < 1

    def apply(self, cutout: Float[Tensor, "s s 4"], azimuth_deg: float, size: int) -> Float[Tensor, "t t 4"]:
        """Return a picture from an azimuth in the square of the input; to the sides, the shift across vanishes."""
        across = self.right * math.cos(math.radians(azimuth_deg))
        zoom = self.factor * size / cutout.shape[0]
        x, y = (-2 * zoom * shift / size for shift in (across, self.down))
        return warped(cutout, torch.tensor([[[zoom, 0, x], [0, zoom, y]]]), size)


def scaling_between(cutout: Float[Tensor, "s s 4"], reference: Float[Tensor, "t t 4"]) -> Scaling:
    """Return the scaling that gives the subject the height and the place that the input shows."""
    left, top, right, bottom = (edge - cutout.shape[0] / 2 for edge in bounding_box(cutout[None, ..., 3]))
    first, upper, last, lower = (edge - reference.shape[0] / 2 for edge in bounding_box(reference[None, ..., 3]))
    factor = (bottom - top) / (lower - upper)
    return Scaling(factor, (first + last - (left + right) / factor) / 2, (upper + lower - (top + bottom) / factor) / 2)


def match_scale(
    cutout: Float[Tensor, "s s 4"], reference: Float[Tensor, "t t 4"], azimuth_deg: float
) -> Float[Tensor, "t t 4"]:
    """Return a picture of another side with the subject's height and vertical place as in the input.

    Across, the subject's middle is put where the input has it, as far as the direction shows that axis.
    """
    scaling = scaling_between(cutout, reference)
    first, _, last, _ = (edge - reference.shape[0] / 2 for edge in bounding_box(reference[None, ..., 3]))
    left, _, right, _ = (edge - cutout.shape[0] / 2 for edge in bounding_box(cutout[None, ..., 3]))
    middle = (first + last) / 2 * math.cos(math.radians(azimuth_deg))
    shift = middle - (left + right) / 2 / scaling.factor
    return Scaling(scaling.factor, shift, scaling.down).apply(cutout, 0, reference.shape[0])


def warped(cutout: Float[Tensor, "h w 4"], matrix: Float[Tensor, "1 2 3"], size: int) -> Float[Tensor, "s s 4"]:
    """Resample a picture with premultiplied alpha at the places that an affine map gives for its own, in [-1, 1]."""
    alpha = cutout[..., 3:]
    planes = torch.cat([cutout[..., :3] * alpha, alpha], -1).permute(2, 0, 1)[None]
    grid = affine_grid(matrix, [1, 4, size, size], align_corners=False)
    return extend_color(unpremultiply(grid_sample(planes, grid, align_corners=False))[0])


def adjust_exposure(views: Sequence[KnownView]) -> list[KnownView]:
    """Return views whose colors agree where they show the same; see `exposure_gains`."""
    return [brightened(view, gain) for view, gain in zip(views, exposure_gains(views), strict=True)]


def exposure_gains(views: Sequence[KnownView]) -> list[Float[Tensor, " 3"] | None]:
    """Return a factor per channel and view by which colors agree where views show the same; None: no change.

    Least squares of the differences of logarithms over pairs of views, each the median over the vertices of the hull
    that both show, with a weak pull to 1. The first view is not changed, nor those whose gain may as well come from
    the coarse hull.

    Args:
        views: of one moment, the input view first.
    """
    volume = hull(views, CELLS)
    vertices, faces = extract(volume)
    colors, weights = observations(vertices, faces, views, volume.step)
    logs = colors.clamp(min=0.02).log()
    count = len(views)
    rows: list[Tensor] = []
    values: list[Tensor] = []
    for i in range(count):
        for j in range(i):
            shared = (weights[i] > 0) & (weights[j] > 0)
            if int(shared.sum()) < FEWEST:
                continue
            row = torch.zeros(count)
            row[i], row[j] = 1, -1
            rows.append(row)
            values.append((logs[j] - logs[i])[shared].median(0).values)
    for i in range(1, count):
        rows.append(torch.eye(count)[i] * STIFFNESS)
        values.append(torch.zeros(3))
    matrix = torch.stack(rows)[:, 1:]  # the first gain is 1
    found = torch.linalg.lstsq(matrix, torch.stack(values)).solution
    gains = [gain.exp().clamp(1 / LARGEST_GAIN, LARGEST_GAIN) for gain in found]
    sure = [float(gain.mean().abs()) >= UNSURE for gain in found]
    return [None, *(gain if is_sure else None for gain, is_sure in zip(gains, sure, strict=True))]


def brightened(view: KnownView, gain: Float[Tensor, " 3"] | None) -> KnownView:
    """Return a view with multiplied colors; the view itself without a gain."""
    if gain is None:
        return view
    return replace(view, cutout=torch.cat([(view.cutout[..., :3] * gain).clamp(0, 1), view.cutout[..., 3:]], -1))
