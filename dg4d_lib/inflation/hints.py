"""Hints at the depth of a subject: turn of its plane, depth picture, or layers, as depth of the middle of its body.

Half the thickness is guessed from the outline (`heights`). So the depth of the middle, and that of the surface that
the picture shows, say the same.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from scipy import ndimage
from torch import Tensor

from dg4d_lib.cameras.orbit import FOV_Y_DEG, RADIUS
from dg4d_lib.errors import BadInput
from dg4d_lib.images import resize_planes
from dg4d_lib.inflation.heights import heights

FARTHEST = 1.0  # world units: largest distance of the middle from z = 0
FADE = 0.1  # world units beside known pixels: within it a hint loses most of its weight
RIM = 3.0  # pixels: parts farther than this from the inside of the subject are all rim
INVERSE_SIGMA, DISTANCE_SIGMA = 0.1, 0.03  # world units: error of the surface by relative and by metric depth
LAYER = 0.15  # world units between mid-gray and white; on synthetic shapes 0.1 to 0.2 score the same
LOW, HIGH = 0.02, 0.98  # quantiles in place of minimum and maximum: depth pictures have outliers
DEPTH_SHARE = 0.5  # assumed range of the visible depths, share of the subject's smaller extent
LEAST_COVERAGE = 0.1  # least covered share of a pixel with a depth
LEAST_KNOWN = 0.25  # least share of the subject's pixels with a depth
FLAT = 1e-4  # range of depths, relative to the median, below which a picture is flat
GRAY_STEP = 2 / 255  # gray levels that differ by less are one layer

DepthKind = Literal["inverse", "distance"]


@dataclass(frozen=True)
class DepthField:
    """Depth of the middle of the body behind the pixels of the first frame.

    Attributes:
        middle: world units along +z, greater is nearer to the input camera.
        known: pixels for which it is known.
        sigma: standard deviation of the surface that the picture shows, world units; 0 if that surface is not known,
            and `middle` is an offset from the subject's plane.
    """

    middle: Float[Tensor, "s s"]
    known: Bool[Tensor, "s s"]
    sigma: float = 0.0


@dataclass(frozen=True)
class DepthHint:
    """Depth hints of a subject.

    Attributes:
        turn_deg: how far its plane is turned about the vertical; positive brings the right side of the picture nearer
            to the camera. Between -60 and 60; None: not known.
        field: depth of the first frame, which takes precedence over the plane.
    """

    turn_deg: float | None = None
    field: DepthField | None = None

    @property
    def is_empty(self) -> bool:
        """True if nothing is known."""
        return self.turn_deg is None and self.field is None

    @property
    def sigma(self) -> float:
        """Standard deviation of the surface that the picture shows, world units; 0 if it is not known."""
        return self.field.sigma if self.field else 0.0

    def middle(self, size: int) -> tuple[Float64[np.ndarray, "{size} {size}"], Float64[np.ndarray, "{size} {size}"]]:
        """Return the middle of the body in a square picture of any frame, world units, and the weight of the field.

        Pixels for which nothing is known, as those that only a later frame covers, take the depth of the nearest known
        one; its weight falls with the distance, from 1 to 0, and the plane takes over.
        """
        plane = turned_plane(size, self.turn_deg or 0.0)
        if self.field is None:
            return plane, np.zeros_like(plane)
        value, known = _resized(self.field, size)
        gap, (rows, columns) = ndimage.distance_transform_edt(~known, return_indices=True)
        weight = np.exp(-np.square(gap * pixel_size(size) / FADE))
        off = value[rows, columns] if self.field.sigma == 0 else value[rows, columns] - plane
        return (plane + weight * off).clip(-FARTHEST, FARTHEST), weight


NO_HINT = DepthHint()


def pixel_size(size: int) -> float:
    """Return the size of a pixel in the plane z = 0, world units, of a square picture by the input camera."""
    return 2 * RADIUS * math.tan(math.radians(FOV_Y_DEG) / 2) / size


def turned_plane(size: int, turn_deg: float) -> Float64[np.ndarray, "{size} {size}"]:
    """Return the depth of a plane turned about the vertical, world units."""
    across = (np.arange(size) + 0.5 - size / 2) * pixel_size(size)
    plane = np.clip(math.tan(math.radians(turn_deg)) * across, -FARTHEST, FARTHEST)
    return np.repeat(plane[None], size, 0)


def depth_field(
    values: Float[Tensor, "s s"],
    coverage: Float[Tensor, "s s"],
    alpha: Float[Tensor, "s s"],
    kind: DepthKind,
    enlargement: float = 1.0,
) -> DepthField:
    """Return the field of a depth picture.

    Distances are those of a camera that sees the whole picture under our field of view. Inverse depth has an unknown
    scale: seen sides are taken to be half as deep as the subject is wide or high. The place along the view is unknown
    in both: the subject, with its back as thick as it is inflated, is put around z = 0.

    Args:
        values: inverse depth (greater is nearer) up to scale and offset, or distance in any unit.
        coverage: share of every pixel that has a value, in [0, 1]; `values` are averages over these shares.
        alpha: of the subject.
        kind: of the values.
        enlargement: size of the subject in the square, relative to the whole picture.

    Raises:
        BadInput: the picture shows little of the subject, or no depth.
    """
    mask = alpha.numpy() > 0.5
    sure = _without_rim(mask) & is_known(coverage).numpy()
    share = known_share(coverage, alpha)
    if share < LEAST_KNOWN or not sure.any():
        raise BadInput(
            f"the depth picture has values for {share:.0%} of the subject, at least {LEAST_KNOWN:.0%} are needed; NaN, "
            "infinity and distances of 0 or less count as unknown"
        )
    found = values.double().numpy()
    low, middle, high = np.quantile(found[sure], (LOW, 0.5, HIGH))
    if high - low <= FLAT * max(abs(middle), FLAT):
        raise BadInput(
            f"the depth picture has one value, {middle:.4g}, all over the subject; give a picture whose brightness, or "
            "distance, changes with the depth"
        )
    pixel = pixel_size(len(mask))
    bulge = heights(mask, pixel)
    if kind == "distance":
        away = RADIUS - float(np.median(bulge[sure]))  # of the surface that the picture shows, from the input camera
        front, sigma = enlargement * away * (1 - found / middle), DISTANCE_SIGMA
    else:
        extent = min(mask.any(0).sum(), mask.any(1).sum()) * pixel
        linear = DEPTH_SHARE * extent * (found - found[sure].mean()) / (high - low)
        front, sigma = RADIUS - RADIUS**2 / (RADIUS + linear.clip(-RADIUS / 2, RADIUS)), INVERSE_SIGMA
    near, far = np.quantile(front[sure], HIGH), np.quantile((front - 2 * bulge)[sure], LOW)
    body = (front - (near + far) / 2 - bulge).clip(-FARTHEST, FARTHEST)
    return DepthField(torch.from_numpy(np.where(sure, body, 0)).float(), torch.from_numpy(sure), sigma)


def is_known(coverage: Float[Tensor, "s s"]) -> Bool[Tensor, "s s"]:
    """Mark the pixels with enough values for an average; of sparse depth, few pixels are covered by half."""
    return coverage > LEAST_COVERAGE


def known_share(coverage: Float[Tensor, "s s"], alpha: Float[Tensor, "s s"]) -> float:
    """Return the share of the subject that a depth picture has values for, in [0, 1]; 0 without a subject."""
    mask = alpha > 0.5
    return float(coverage[mask].mean()) if mask.any() else 0.0


def layer_field(levels: Float[Tensor, "s s"], known: Bool[Tensor, "s s"], alpha: Float[Tensor, "s s"]) -> DepthField:
    """Return the field of a picture of layers: mid-gray lies in the subject's plane, lighter is nearer.

    Args:
        levels: gray in [0, 1].
        known: pixels with a level.
        alpha: of the subject.

    Raises:
        BadInput: no level differs from the plane, or all are the same.
    """
    mask = alpha > 0.5
    shown = known & mask
    if not shown.any():
        raise BadInput("the layers are transparent all over the subject; paint its parts in gray levels")
    painted = levels[shown]
    same = float(painted.max() - painted.min()) < GRAY_STEP
    if same and (bool((shown == mask).all()) or abs(float(painted.mean()) - 0.5) < GRAY_STEP):
        raise BadInput(
            f"the layers have one level all over the subject, {round(255 * float(painted.mean()))} of 255, and carry "
            "no depth; paint nearer parts lighter than mid-gray (128), farther parts darker"
        )
    return DepthField(torch.where(shown, 2 * LAYER * (levels - 0.5), 0.0), shown)


def _without_rim(mask: Bool[np.ndarray, "s s"]) -> Bool[np.ndarray, "s s"]:
    """Return the inside of a mask, whole where it is thin: depth pictures mix subject and background at the rim."""
    inside = ndimage.binary_erosion(mask)
    if not inside.any():
        return mask
    return inside | (mask & (ndimage.distance_transform_edt(~inside) > RIM))


def _resized(
    field: DepthField, size: int
) -> tuple[Float64[np.ndarray, "{size} {size}"], Bool[np.ndarray, "{size} {size}"]]:
    """Return depth and known pixels at another size; at least one pixel is known."""
    known = field.known.float()
    planes = torch.stack([field.middle * known, known])[None]
    value, share = resize_planes(planes, (size, size))[0].double().numpy()
    least = min(0.5, float(share.max()))
    return value / np.maximum(share, 1e-6), share >= least
