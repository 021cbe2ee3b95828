"""Scale, place and exposure of known views, adjusted to the input view."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import affine_grid, grid_sample

from dg4d_lib.video.framing import bounding_box, extend_color, unpremultiply
from dg4d_lib.visual_hull.carve import hull
from dg4d_lib.visual_hull.known import KnownView
from dg4d_lib.visual_hull.surface import extract, observations

SAME_SCALE = 0.12  # relative difference of heights that perspective explains: larger ones are a difference of scale
CELLS = 64
FEWEST = 30  # vertices that two views must share for a comparison of their exposure
STIFFNESS = 0.05  # of the gains at 1, relative to a pair that overlaps fully
LARGEST_GAIN = 2.0
UNSURE = 0.22  # mean logarithm of a gain that the hull's wrong places alone can cause: on equal exposures up to 0.21


def same_scale(cutout: Float[Tensor, "s s 4"], reference: Float[Tensor, "s s 4"]) -> bool:
    """Return True if a picture shows the subject at the height and size at which the input view shows it."""
    _, top, _, bottom = bounding_box(cutout[None, ..., 3])
    _, upper, _, lower = bounding_box(reference[None, ..., 3])
    height = lower - upper
    return max(abs(top - upper), abs(bottom - lower), abs(bottom - top - height)) <= SAME_SCALE * height


def match_scale(
    cutout: Float[Tensor, "s s 4"], reference: Float[Tensor, "s s 4"], azimuth_deg: float
) -> Float[Tensor, "s s 4"]:
    """Scale and shift a picture so that the subject has the height and vertical place that the input view shows.

    Across, the subject's middle is put where the input view has it, as far as the direction shows that axis.
    """
    size = reference.shape[0]
    left, top, right, bottom = bounding_box(cutout[None, ..., 3])
    first, upper, last, lower = bounding_box(reference[None, ..., 3])
    scale = (bottom - top) / (lower - upper)  # picture pixels per pixel of the result
    middle = ((first + last) / 2 - size / 2) * math.cos(math.radians(azimuth_deg)) + size / 2
    x = (left + right) / 2 - (middle - size / 2) * scale
    y = (top + bottom) / 2 - ((upper + lower) / 2 - size / 2) * scale
    side = cutout.shape[0]
    matrix = torch.tensor([[[scale * size / side, 0, 2 * x / side - 1], [0, scale * size / side, 2 * y / side - 1]]])
    return warped(cutout, matrix, size)


def warped(cutout: Float[Tensor, "h w 4"], matrix: Float[Tensor, "1 2 3"], size: int) -> Float[Tensor, "s s 4"]:
    """Resample a picture with premultiplied alpha at the places that an affine map gives for its own, in [-1, 1]."""
    alpha = cutout[..., 3:]
    planes = torch.cat([cutout[..., :3] * alpha, alpha], -1).permute(2, 0, 1)[None]
    grid = affine_grid(matrix, [1, 4, size, size], align_corners=False)
    return extend_color(unpremultiply(grid_sample(planes, grid, align_corners=False))[0])


def adjust_exposure(views: Sequence[KnownView]) -> list[KnownView]:
    """Return views whose colors are multiplied so that they agree where they show the same, the first unchanged.

    One gain per view and channel: least squares of the differences of logarithms over pairs of views, each the median
    over the vertices of the hull that both show, with a weak pull to 1.
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
    gains = torch.linalg.lstsq(matrix, torch.stack(values)).solution
    return [views[0], *(_brighter(view, gain) for view, gain in zip(views[1:], gains, strict=True))]


def _brighter(view: KnownView, log_gain: Float[Tensor, " 3"]) -> KnownView:
    """Return the view itself if its gain may as well come from the coarse hull."""
    if float(log_gain.mean().abs()) < UNSURE:
        return view
    gain = log_gain.exp().clamp(1 / LARGEST_GAIN, LARGEST_GAIN)
    return replace(view, cutout=torch.cat([(view.cutout[..., :3] * gain).clamp(0, 1), view.cutout[..., 3:]], -1))
