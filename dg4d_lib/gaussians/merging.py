"""Simplification of clouds: neighboring Gaussians of similar color are merged pair by pair (Ward 1963)."""

import math
from dataclasses import replace
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.gaussians.transform import concatenate
from dg4d_lib.kernels.compiling import njit

NEIGHBORS = 6  # merge candidates of a Gaussian in a round
VISIBLE = 1 / 255  # opacity below which a Gaussian is not drawn
COLOR = 0.1  # difference in color, in [0, 1], that counts as much as `DISTANCE`
DISTANCE = 1 / 60  # share of the cloud's radius
KNUD_THOMSEN = 1.6075  # exponent in the approximate surface area of ellipsoids
HIGHEST_OPACITY = 0.995
PAIRS = 0.4  # largest number of pairs per Gaussian in a round; later ones would mix different colors
LARGEST_SCALE, LARGEST_LOGIT = 40.0, 20.0  # logarithm of the model's units, and logit: files hold any number
THINNEST = 1e-12  # variance of a pair across a disc, of the sum of its variances, at least
JITTER = 1e-10  # relative to the largest coordinate, or to 1: coincident Gaussians would all have the same neighbors


def merge_gaussians(cloud: Gaussians, most: int) -> Gaussians:
    """Merge the Gaussians of one state until at most `most` are left.

    In each round, pairs of neighbors are merged in the order of what merging them costs: the loss of variance of
    positions and colors, weighted by opacity and area. A pair becomes a Gaussian with its mean, covariance and color,
    whose opacity keeps the sum of opacity times area, less what both cover already.

    Args:
        cloud: one state, with view-independent colors.
        most: at least 1.
    """
    if len(cloud) <= most:
        return cloud
    visible = torch.nonzero(cloud.opacities >= VISIBLE)[:, 0]
    if len(visible) < most:  # a nearly transparent cloud keeps its most visible Gaussians
        visible = cloud.opacities.topk(most).indices.sort().values
    given, cloud = cloud.means.dtype, cloud.subset(visible).to(torch.float64)
    cloud = replace(
        cloud,
        log_scales=cloud.log_scales.clamp(-LARGEST_SCALE, LARGEST_SCALE),
        opacity_logits=cloud.opacity_logits.clamp(min=-LARGEST_LOGIT),
    )
    center = cloud.means.median(0).values
    radius = float((cloud.means - center).norm(dim=1).median().clamp_min(1e-12))
    while (excess := len(cloud) - most) > 0:
        first, second = _cheapest_pairs(cloud, radius, excess)
        alone = torch.ones(len(cloud), dtype=torch.bool)
        alone[first] = alone[second] = False
        merged = _merge(cloud.subset(first), cloud.subset(second))
        cloud = concatenate([cloud.subset(alone), merged])
    return cloud.to(given)


def _masses(cloud: Gaussians) -> Float[Tensor, " n"]:
    """Return opacity times surface area, up to a constant factor."""
    return cloud.opacities * _areas(cloud.scales)


def _areas(scales: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """Return the surface areas of ellipsoids, up to a constant factor."""
    power = scales**KNUD_THOMSEN
    products = power * power.roll(1, dims=1)
    return products.mean(1) ** (1 / KNUD_THOMSEN)


def _cheapest_pairs(cloud: Gaussians, radius: float, most: int) -> tuple[Int[Tensor, " p"], Int[Tensor, " p"]]:
    """Return disjoint pairs of neighbors, the cheapest ones, at most `most`."""
    points = cloud.means.numpy()
    count = len(points)
    jitter = JITTER * max(np.abs(points).max(), 1.0) * np.random.default_rng(0).standard_normal(points.shape)
    near = cKDTree(points + jitter).query(points + jitter, k=min(NEIGHBORS, count - 1) + 1, workers=-1)[1]
    rows, near = np.repeat(np.arange(count), near.shape[1]), near.ravel()
    keys = np.unique((np.minimum(rows, near) * count + np.maximum(rows, near))[rows != near])
    first, second = np.divmod(keys, count)
    masses = _masses(cloud).numpy()
    spread = masses[first] * masses[second] / (masses[first] + masses[second])
    colors = cloud.colors.numpy()
    distance = np.square(points[first] - points[second]).sum(1) / (DISTANCE * radius) ** 2
    difference = np.square(colors[first] - colors[second]).sum(1) / COLOR**2
    order = np.argsort(spread * (distance + difference), kind="stable")
    selected = order[_disjoint(first[order], second[order], count, min(most, math.ceil(PAIRS * count)))]
    return torch.from_numpy(first[selected]), torch.from_numpy(second[selected])


@njit(cache=True)
@no_type_check
def _disjoint(first, second, count, most):
    """Return the places of pairs, in order, that share no member with an earlier one."""
    taken = np.zeros(count, np.bool_)
    selected = np.empty(most, np.int64)
    found = 0
    for place in range(len(first)):
        a, b = first[place], second[place]
        if not (taken[a] or taken[b]):
            taken[a] = taken[b] = True
            selected[found] = place
            found += 1
            if found == most:
                break
    return selected[:found]


def _merge(first: Gaussians, second: Gaussians) -> Gaussians:
    """Return a Gaussian for each pair, by its moments."""
    masses = torch.stack([_masses(first), _masses(second)])
    shares = (masses / masses.sum(0))[..., None]

    def mean(name: str) -> Tensor:
        return (shares * torch.stack([getattr(first, name), getattr(second, name)]).flatten(2)).sum(0)

    means = mean("means")
    covariances = torch.zeros_like(first.covariances)
    for share, one in zip(shares, (first, second), strict=True):
        offsets = one.means - means
        covariances += share[..., None] * (one.covariances + offsets[:, :, None] * offsets[:, None])
    variances, axes = torch.linalg.eigh(covariances)
    axes[..., 0] *= torch.linalg.det(axes).sign()[:, None]  # a rotation, no reflection
    scales = variances.clamp_min(math.exp(-2 * LARGEST_SCALE)).sqrt()
    opacities = (masses.sum(0) - _shared_mass(first, second)) / _areas(scales)
    scales = scales * (opacities / HIGHEST_OPACITY).clamp_min(1).sqrt()[:, None]
    opacities = opacities.clamp(VISIBLE, HIGHEST_OPACITY)
    quats = torch.from_numpy(Rotation.from_matrix(axes.numpy()).as_quat(scalar_first=True))
    return Gaussians(means, scales.log(), quats, opacities.logit(), mean("harmonics")[:, None])


def _shared_mass(first: Gaussians, second: Gaussians) -> Float[Tensor, " p"]:
    """Return the part of the masses of pairs that covers the same place: all that both cover if they coincide."""
    offsets = (second.means - first.means)[..., None]
    both = first.covariances + second.covariances
    smallest = THINNEST * both.diagonal(dim1=-2, dim2=-1).sum(-1)  # else rounding makes thin discs singular
    both.diagonal(dim1=-2, dim2=-1).add_(smallest[:, None])
    overlap = (-0.5 * offsets.mT @ torch.linalg.solve(both, offsets)).exp()[:, 0, 0]
    return overlap * first.opacities * second.opacities * torch.minimum(*map(_areas, (first.scales, second.scales)))
