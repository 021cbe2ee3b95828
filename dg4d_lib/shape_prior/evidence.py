"""Evidence of a hint at the depth of a subject, as log-odds that are added to those of the network."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from scipy import ndimage
from torch import Tensor

from dg4d_lib.cameras.orbit import RADIUS
from dg4d_lib.inflation.heights import heights
from dg4d_lib.inflation.hints import DepthHint
from dg4d_lib.shape_prior.frustum import BINS, FAR, NEAR, SIZE, TAN_HALF_FOV

PLANE_SIGMA = 0.3  # world units: standard deviation of the body's middle about a plane, or layers, of a user
OWN_BLUR = 10.0  # pixels: a plane is compared with the network's own middle without detail
FRONT = 4.0  # logits right before and right behind a surface that is known
BEHIND = 2.0  # logits against matter from twice the expected thickness on
THINNEST = 0.04  # world units: half thickness of parts that the outline shows thinner
JUMP = 0.2  # world units between neighboring pixels: a part before another one
BESIDE = 3  # pixels around a jump: at least two, as jumps are two wide
PIXEL = 4 * TAN_HALF_FOV / SIZE  # world units in the plane z = 0
DEPTHS = RADIUS - (NEAR + (np.arange(BINS) + 0.5) * (FAR - NEAR) / BINS)  # middles of the cells, world units along +z


def hint_evidence(
    hint: DepthHint, logits: Float[Tensor, "128 128 64"], mask: Bool[Tensor, "128 128"]
) -> Float[Tensor, "128 128 64"]:
    """Return what a hint adds to the logits of the network.

    Args:
        hint: at the depth of the subject.
        logits: of every cell lying inside the subject, by the network alone.
        mask: pixels of the subject.
    """
    if hint.is_empty or not mask.any():
        return torch.zeros_like(logits)
    middle, weight = hint.middle(SIZE)
    inside = mask.numpy()
    if hint.sigma:
        bulge = heights(inside, PIXEL)
        front = (middle + bulge).clip(DEPTHS[-1] + THINNEST, DEPTHS[0])  # deeper or nearer, rays would be empty
        thickness = np.maximum(2 * np.maximum(bulge, THINNEST), _bridges(front, inside))
        return torch.from_numpy(weight[..., None] * front_evidence(front, thickness, hint.sigma)).to(logits)
    return torch.from_numpy(middle_evidence(middle, own_middle(logits, inside))).to(logits)


def middle_evidence(
    middle: Float64[np.ndarray, "s s"], own: Float64[np.ndarray, "s s"]
) -> Float64[np.ndarray, "s s d"]:
    """Return the log ratio of Gaussians about the hinted middle and about that of the network."""
    offset = (middle - own)[..., None]
    return offset * (2 * DEPTHS - (middle + own)[..., None]) / (2 * PLANE_SIGMA**2)


def front_evidence(
    front: Float64[np.ndarray, "s s"], thickness: Float64[np.ndarray, "s s"], sigma: float
) -> Float64[np.ndarray, "s s d"]:
    """Return occupancy log-odds on rays whose first surface is known.

    The space in front of it is free. Cells behind it are occupied, with less certainty the deeper, down to the expected
    thickness.

    Args:
        front: depth of the surface, world units along +z.
        thickness: expected behind it, world units.
        sigma: standard deviation of the surface's depth, world units.
    """
    deep = front[..., None] - DEPTHS
    behind = 1 / (1 + np.exp(-(2 * deep / sigma).clip(-50, 50)))
    past = deep / thickness[..., None] - 1
    matter = np.where(past < 0, -FRONT * past, -BEHIND * past.clip(0, 1))
    return behind * matter - (1 - behind) * FRONT


def _bridges(front: Float64[np.ndarray, "s s"], mask: Bool[np.ndarray, "s s"]) -> Float64[np.ndarray, "s s"]:
    """Return the thickness that joins parts which jumps of depth would tear off, beside these jumps; else 0.

    A far leg goes on behind the body that covers it, though no pixel shows it there.
    """
    deep, near = np.where(mask, front, np.inf), np.where(mask, front, -np.inf)
    calm = mask & (ndimage.maximum_filter(near, 3) - ndimage.minimum_filter(deep, 3) <= JUMP)
    parts, count = ndimage.label(calm)
    if count < 2:
        return np.zeros_like(front)
    largest = 1 + int(np.argmax(np.bincount(parts.ravel())[1:]))
    beside = [ndimage.maximum_filter(calm & each, 2 * BESIDE + 1) for each in (parts == largest, parts != largest)]
    return np.where(mask & beside[0] & beside[1], 2 * (front - ndimage.minimum_filter(deep, 2 * BESIDE + 1)), 0.0)


def own_middle(logits: Float[Tensor, "s s d"], mask: Bool[np.ndarray, "s s"]) -> Float64[np.ndarray, "s s"]:
    """Return the mean depth of the matter that the network expects, smoothed inside of the subject."""
    matter = logits.double().sigmoid().numpy()
    middle = (matter @ DEPTHS) / np.maximum(matter.sum(-1), 1e-6)
    share = ndimage.gaussian_filter(mask.astype(float), OWN_BLUR)
    smooth: Float64[np.ndarray, "s s"] = ndimage.gaussian_filter(middle * mask, OWN_BLUR) / np.maximum(share, 1e-6)
    return smooth
