"""Shapes decided from probabilities of matter: sharper than these, with as much matter on every ray."""

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

STEPS = 20  # of the bisection
RANGE = 30.0  # logits: largest shift of a ray
GENEROSITY = 1.0  # cells of matter per unit of variance on a ray: unsure shapes overlap most with more than is expected
LEAST = 1.0  # cells of matter on a ray of the subject
TIE = 1e-3  # logits by which the ends of a ray are less probable than its middle
OFF_MIDDLE = 0.01  # shift of that middle, in halves of a ray, so that no two cells are equal


def smooth_logits(
    logits: Float[Tensor, "128 128 64"], mask: Bool[Tensor, "128 128"], smoothness: float
) -> Float[Tensor, "128 128 64"]:
    """Return logits averaged with those of neighboring cells of the subject; the outline stays where it is.

    Args:
        logits: of every cell lying inside the subject.
        mask: pixels of the subject.
        smoothness: standard deviation of the blur, cells.
    """
    inside = mask.numpy()[..., None].astype(np.float32)
    share = ndimage.gaussian_filter(inside, (smoothness, smoothness, 0))
    smooth = ndimage.gaussian_filter(logits.numpy() * inside, smoothness) / np.maximum(share, 1e-3)
    return torch.where(mask[..., None], torch.from_numpy(smooth), logits)


def matter_on(rays: Float[Tensor, "n 64"], generosity: float) -> Float[Tensor, "n 1"]:
    """Return the cells of matter on rays: the expected number, and more where it is unsure."""
    inside = rays.sigmoid()
    expected = (inside + generosity * inside * (1 - inside)).sum(-1, keepdim=True)
    return expected.clamp(LEAST, rays.shape[-1] - LEAST)


def most_probable(
    logits: Float[Tensor, "128 128 64"], mask: Bool[Tensor, "128 128"], generosity: float = 0.0
) -> Float[Tensor, "128 128 64"]:
    """Return a field that is positive in the most probable cells of every ray, as many as matter is expected on it.

    Args:
        logits: of every cell lying inside the subject.
        mask: pixels of the subject.
        generosity: matter to add per unit of its variance, where its place is unsure.

    Returns:
        Values in [-1, 1]; 1 at the best cell of each of these rays, -1 on all others.
    """
    middle = torch.linspace(-1, 1 + OFF_MIDDLE, logits.shape[-1]).abs()
    rays = logits[mask] - TIE * middle
    expected = matter_on(logits[mask], generosity)
    ranked = rays.sort(-1, descending=True).values
    first = (expected - 0.5).floor().long()  # the middle of cell number k of the ranking lies at k + 1/2
    share = expected - 0.5 - first
    level = ranked.gather(-1, first) * (1 - share) + ranked.gather(-1, first + 1) * share
    field = torch.full_like(logits, -1.0)
    field[mask] = ((rays - level) / (ranked[:, :1] - level)).clamp(-1, 1)
    return field


def decide(
    logits: Float[Tensor, "128 128 64"], mask: Bool[Tensor, "128 128"], contrast: float, generosity: float = 0.0
) -> Float[Tensor, "128 128 64"]:
    """Return logits times a contrast, shifted on every ray so that its expected matter stays the same.

    Without the shift, matter whose depth is unsure would vanish: each of its cells is improbable.

    Args:
        logits: of every cell lying inside the subject.
        mask: pixels of the subject; other rays stay as they are.
        contrast: 1 changes nothing; with a large one, matter lies in the most probable cells alone.
        generosity: matter to add per unit of its variance, where its place is unsure.
    """
    rays = logits[mask]
    expected = matter_on(rays, generosity)
    low, high = torch.full_like(expected, -RANGE), torch.full_like(expected, RANGE)
    for _ in range(STEPS):
        middle = (low + high) / 2
        much = (contrast * (rays + middle)).sigmoid().sum(-1, keepdim=True) > expected
        low, high = torch.where(much, low, middle), torch.where(much, middle, high)
    decided = logits.clone()
    decided[mask] = contrast * (rays + (low + high) / 2)
    return decided
