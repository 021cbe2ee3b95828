"""Density field of a Gaussian cloud; its level set is the surface.

density(p) = sum_i opacity_i exp(-0.5 d^T Sigma_i^-1 d), d = p - mean_i (Tang et al. 2024, 3.2).
"""

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dg4d_lib.errors import BadInput, FitDiverged
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.quaternion import quat_to_rotmat
from dg4d_lib.kernels.compiling import njit
from dg4d_lib.settings import MeshSettings

LONGEST_SIDE = 1.8  # of the bounding box of the means, in the field's box [-1, 1]
MARGIN = 2.0  # standard deviations around every mean that the field must contain
REACH = 4.0  # standard deviations at which a Gaussian is cut off; the rest is below opacity * exp(-8) = 3.4e-4
THINNEST = 0.7  # cells; smaller standard deviations are raised to this, else flat Gaussians fall between the samples


@dataclass(frozen=True)
class DensityField:
    """Density sampled at the cell centers of a cube.

    Attributes:
        values: densities, indexed x, y, z.
        origin: position of the first sample, world units.
        cell: distance between samples, world units.
        unit: world length of one unit of the normalized box, which spans [-1, 1].
    """

    values: Float[Tensor, "r r r"]
    origin: Float[Tensor, " 3"]
    cell: float
    unit: float


def density_field(gaussians: Gaussians, settings: MeshSettings) -> DensityField:
    """Sample the density of one cloud on `settings.grid` cells per axis.

    The bounding box of the means is centered and its longest side takes 1.8 of the box's 2 units, less if large
    Gaussians need room. Standard deviations below 0.7 cells are raised to that with unchanged opacity, so a flat
    Gaussian keeps its peak; this moves a level set outwards by less than one cell. Each Gaussian is cut off at four
    standard deviations, where it is below 3.4e-4 times its opacity.

    Raises:
        BadInput: the cloud is a batch of states; give one state.
        FitDiverged: parameters are not finite, or no Gaussian is more opaque than `settings.min_opacity`.
    """
    if gaussians.means.dim() != 2:
        raise BadInput(
            f"the density is computed for one state of a cloud; given a batch of shape "
            f"{tuple(gaussians.means.shape[:-2])}: select one with Gaussians.at"
        )
    opacities = gaussians.opacities.double()
    shown = opacities > settings.min_opacity
    means, scales = gaussians.means.double()[shown], gaussians.scales.double()[shown]
    axes = quat_to_rotmat(gaussians.quats.double()[shown])
    if not bool(shown.any()):
        raise FitDiverged(
            f"no surface: none of {len(gaussians)} Gaussians is more opaque than mesh.min_opacity = "
            f"{settings.min_opacity}; the model is empty, fit it again"
        )
    if not all(bool(t.isfinite().all()) for t in (means, scales, axes)):
        raise FitDiverged("no surface: some Gaussians are not finite (NaN or infinity); fit the model again")

    low, high = means.amin(0), means.amax(0)
    center = (low + high) / 2
    far = (means - center).abs() + MARGIN * (axes * scales[:, None, :]).norm(dim=-1)
    unit = max(float((high - low).amax()) / LONGEST_SIDE, float(far.amax()))
    cell = 2 * unit / settings.grid
    origin = center - unit + cell / 2

    scales = scales.clamp_min(THINNEST * cell)
    half_inverse = (axes / scales[:, None, :]).mT  # M with d^T Sigma^-1 d = |M d|^2
    reach = REACH * (axes * scales[:, None, :]).norm(dim=-1)  # half sides of the ellipsoid's bounding box
    values = np.zeros((settings.grid,) * 3, np.float32)
    _splat(
        ((means - origin) / cell).numpy(force=True),
        (half_inverse * cell).numpy(force=True),
        (reach / cell).numpy(force=True),
        opacities[shown].numpy(force=True),
        values,
    )
    return DensityField(torch.from_numpy(values), origin.cpu(), cell, unit)


@njit(cache=True, nogil=True)
@no_type_check
def _splat(means, half_inverse, reach, opacities, values):
    """Add every Gaussian to the samples inside its ellipsoid; lengths in cells.

    Along z the logarithm is a quadratic function, so the ratio of successive values changes by a constant factor.
    """
    size = values.shape[0]
    first, last = np.zeros(2, np.int64), np.zeros(2, np.int64)
    for i in range(means.shape[0]):
        for a in range(2):
            first[a] = max(0, int(np.ceil(means[i, a] - reach[i, a])))
            last[a] = min(size - 1, int(np.floor(means[i, a] + reach[i, a])))
        h = half_inverse[i]
        square = h[0, 2] * h[0, 2] + h[1, 2] * h[1, 2] + h[2, 2] * h[2, 2]
        factor = np.exp(-square)
        for x in range(first[0], last[0] + 1):
            dx = x - means[i, 0]
            for y in range(first[1], last[1] + 1):
                dy = y - means[i, 1]
                u0, u1, u2 = h[0, 0] * dx + h[0, 1] * dy, h[1, 0] * dx + h[1, 1] * dy, h[2, 0] * dx + h[2, 1] * dy
                constant, linear = u0 * u0 + u1 * u1 + u2 * u2, u0 * h[0, 2] + u1 * h[1, 2] + u2 * h[2, 2]
                middle = -linear / square
                inside = REACH * REACH - constant - linear * middle  # less the smallest squared distance of the line
                if inside <= 0:
                    continue
                half = np.sqrt(inside / square)
                start = max(0, int(np.ceil(means[i, 2] + middle - half)))
                end = min(size - 1, int(np.floor(means[i, 2] + middle + half)))
                dz = start - means[i, 2]
                value = opacities[i] * np.exp(-0.5 * (constant + dz * (2 * linear + dz * square)))
                ratio = np.exp(-linear - square * (dz + 0.5))
                for z in range(start, end + 1):
                    values[x, y, z] += value
                    value *= ratio
                    ratio *= factor
