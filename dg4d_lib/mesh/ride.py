"""One surface for all times: vertices ride the Gaussians around them.

A vertex moves with the rigid motion that fits its neighborhood best (moving least squares with rotations: Schaefer et al. 2006,
section 3; Muller et al. 2005). Both the centers of the Gaussians and their own rotations say how the neighborhood turns
(oriented particles: Muller and Chentanez 2011); either alone is noisier.
"""

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from torch import Tensor

from dg4d_lib.deformation.interface import Displacement
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.quaternion import rotation_matrix

NEIGHBORS = 24  # Gaussians that carry a vertex
FAINT = 0.005  # less opaque Gaussians carry nothing, their motion is not seen
FALLBACK = 0.01  # weight of mere nearness against that of density
THINNEST = 0.25  # of the neighborhood's size: flat Gaussians carry what is near, not only what lies in their plane
OWN_ROTATION = 0.5  # weight of the Gaussians' own rotations, per squared size of the neighborhood


def ride(
    vertices: Float[Tensor, "v 3"], gaussians: Gaussians, displacement: Displacement
) -> Float[Tensor, "t v 3"]:
    """How far every vertex has gone at every time.

    Args:
        vertices: of the surface of `gaussians` as they are, world units.
        gaussians: one state, at rest: what the displacement is added to.
        displacement: of the Gaussians from rest, at t times.

    Returns:
        What to add to the vertices, world units. A rigid motion of all Gaussians moves the vertices by the same motion.

    Raises:
        BadInput: the cloud is empty or not a single state.
    """
    if gaussians.means.dim() != 2 or len(gaussians) == 0:
        raise BadInput(f"vertices ride one state of a cloud that is not empty; given {tuple(gaussians.means.shape)}")
    points = vertices.double().cpu()
    rest = gaussians.to(torch.device("cpu")).to(torch.float64)
    weights = _weights(points, rest)
    center = _mean(weights, rest.means)
    size2 = (_mean(weights, rest.means.square()) - center.square()).sum(-1).clamp_min(0)
    own = OWN_ROTATION * size2[:, None, None] + 1e-12
    back = rotation_matrix(rest.quats).mT

    offsets = torch.empty(displacement.means.shape[0], len(points), 3, dtype=torch.float64)
    for time, (means, quats) in enumerate(zip(displacement.means, displacement.quats, strict=True)):
        moved = rest.means + means.double().cpu()
        turns = rotation_matrix(rest.quats + quats.double().cpu()) @ back
        there = _mean(weights, moved)
        moments = _mean(weights, moved[:, :, None] * rest.means[:, None, :]) - there[:, :, None] * center[:, None, :]
        rotation = _nearest_rotation(moments + own * _mean(weights, turns))
        offsets[time] = there + (rotation @ (points - center)[..., None])[..., 0] - points
    return offsets.to(vertices)


def _weights(points: Float[Tensor, "v 3"], rest: Gaussians) -> csr_array:
    """How much of a vertex (row) every Gaussian (column) carries: its share of the density there. Rows sum to 1."""
    shown = torch.nonzero(rest.opacities > FAINT)[:, 0]
    if len(shown) == 0:
        shown = torch.arange(len(rest))
    count = min(NEIGHBORS, len(shown))
    distance, nearest = cKDTree(rest.means[shown].numpy()).query(points.numpy(), k=range(1, count + 1))
    carriers, distance = shown[torch.from_numpy(nearest)], torch.from_numpy(distance)
    reach = distance[:, -1:].clamp_min(1e-9)
    axes = rotation_matrix(rest.quats)[carriers]
    scales = rest.scales[carriers].maximum(THINNEST * reach[..., None])
    arms = points[:, None] - rest.means[carriers]
    local = (arms[..., None, :] @ axes)[..., 0, :] / scales
    density = torch.exp(-0.5 * local.square().sum(-1))
    nearness = torch.exp(-4.5 * (distance / reach).square())  # three standard deviations at the last neighbor
    weights = rest.opacities[carriers] * (density + FALLBACK * nearness)
    weights = weights / weights.sum(-1, keepdim=True)
    rows = np.arange(0, carriers.numel() + 1, count)
    return csr_array((weights.flatten().numpy(), carriers.flatten().numpy(), rows), shape=(len(points), len(rest)))


def _mean(weights: csr_array, values: Float[Tensor, "n *c"]) -> Float[Tensor, "v *c"]:
    """The weighted means of what the Gaussians have, for every vertex."""
    return torch.from_numpy(weights @ values.flatten(1).numpy()).unflatten(1, values.shape[1:])


def _nearest_rotation(matrices: Float[Tensor, "v 3 3"]) -> Float[Tensor, "v 3 3"]:
    """The proper rotations nearest to the matrices (Kabsch 1976; Umeyama 1991)."""
    left, _, right = torch.linalg.svd(matrices)
    flip = torch.ones_like(matrices[:, 0])
    flip[:, 2] = torch.linalg.det(left @ right).sign()
    return left @ (flip[..., None] * right)
