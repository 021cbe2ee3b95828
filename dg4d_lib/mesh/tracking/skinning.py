"""Skinning of mesh vertices to the Gaussians around them, with fixed topology.

A vertex moves with the rigid motion that fits its neighborhood best (moving least squares with rotations: Schaefer et
al. 2006, section 3; Mueller et al. 2005). The rotation is estimated from the centers of the Gaussians and from their
own rotations (oriented particles: Mueller and Chentanez 2011). Neighbors that move away from the dominant one, such as
those of the other leg, get little weight.
"""

from functools import partial
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from dg4d_lib.deformation.interface import Displacement
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.quaternion import quat_to_rotmat
from dg4d_lib.geometry.rotation import nearest_rotation
from dg4d_lib.kernels.compiling import njit
from dg4d_lib.kernels.workers import run_parallel

NEIGHBORS = 24  # Gaussians per vertex
FAINT = 0.005  # opacity below which a Gaussian is invisible and gets no weight
FALLBACK = 0.01  # weight of proximity relative to density
THINNEST = 0.25  # minimum scale of a Gaussian relative to the neighborhood; flat ones then also act off their plane
PARTING = 0.5  # standard deviation of tolerated changes of distance to the dominant Gaussian, in neighborhood radii
OWN_ROTATION = 0.5  # weight of the Gaussians' own rotations, per squared size of the neighborhood


def skin_vertices(
    vertices: Float[Tensor, "v 3"], gaussians: Gaussians, displacement: Displacement
) -> Float[Tensor, "t v 3"]:
    """Skin vertices to the Gaussians and return their offsets over time.

    Args:
        vertices: on the surface of `gaussians`, world units.
        gaussians: one state, to which the displacement is added.
        displacement: of the Gaussians, at t timestamps.

    Returns:
        Offsets of the vertices, world units. A rigid motion of all Gaussians moves the vertices by the same motion.

    Raises:
        BadInput: the cloud is empty or not a single state.
    """
    if gaussians.means.dim() != 2 or len(gaussians) == 0:
        raise BadInput(
            f"skinning needs one state of a non-empty cloud, means of shape (n, 3); "
            f"given {tuple(gaussians.means.shape)}"
        )
    points = vertices.double().cpu()
    rest = gaussians.to(torch.device("cpu")).to(torch.float64)
    moved = (rest.means + displacement.means.double().cpu()).numpy()
    bones, weights = (part.numpy() for part in _skinning_weights(points, rest))
    _drop_parting_bones(bones, weights, points.numpy(), rest.means.numpy(), moved)
    back = quat_to_rotmat(rest.quats).mT
    offsets = np.empty((len(moved), len(points), 3))

    def move(time: int) -> None:
        turns = quat_to_rotmat(rest.quats + displacement.quats[time].double().cpu()) @ back
        _move(bones, weights, points.numpy(), rest.means.numpy(), moved[time], turns.numpy(), offsets[time])

    run_parallel([partial(move, time) for time in range(len(offsets))])
    return torch.from_numpy(offsets).to(vertices)


def _skinning_weights(points: Float[Tensor, "v 3"], rest: Gaussians) -> tuple[Int[Tensor, "v k"], Float[Tensor, "v k"]]:
    """Return the Gaussians of every vertex and their weights, which are their shares of the density and sum to 1."""
    shown = torch.nonzero(rest.opacities > FAINT)[:, 0]
    if len(shown) == 0:
        shown = torch.arange(len(rest))
    count = min(NEIGHBORS, len(shown))
    found = cKDTree(rest.means[shown].numpy()).query(points.numpy(), k=range(1, count + 1))
    distance, nearest = (torch.from_numpy(np.asarray(a)) for a in found)
    bones = shown[nearest]
    reach = distance[:, -1:].clamp_min(1e-9)
    axes = quat_to_rotmat(rest.quats)[bones]
    scales = rest.scales[bones].maximum(THINNEST * reach[..., None])
    arms = points[:, None] - rest.means[bones]
    local = (arms[..., None, :] @ axes)[..., 0, :] / scales
    density = torch.exp(-0.5 * local.square().sum(-1))
    nearness = torch.exp(-4.5 * (distance / reach).square())  # three standard deviations at the last neighbor
    weights = rest.opacities[bones] * (density + FALLBACK * nearness)
    return bones, weights / weights.sum(-1, keepdim=True)


@njit(cache=True, nogil=True)
@no_type_check
def _drop_parting_bones(bones, weights, points, rest, moved):
    """Reduce the weights of Gaussians whose distance to the dominant one changes over time.

    The dominant one has the largest total weight of Gaussians that move with it. The rows are normalized to sum 1.
    """
    count, times = bones.shape[1], moved.shape[0]
    agree = np.empty((count, count))
    paths = np.empty((count, times + 1, 3))  # at rest, then at every timestamp: close together in memory
    for v in range(bones.shape[0]):
        reach2 = 1e-18
        for k in range(count):
            i, distance2 = bones[v, k], 0.0
            for a in range(3):
                paths[k, 0, a] = rest[i, a]
                distance2 += (rest[i, a] - points[v, a]) ** 2
                for t in range(times):
                    paths[k, t + 1, a] = moved[t, i, a]
            reach2 = max(reach2, distance2)
        agree[:] = 1.0
        for k in range(count):
            for m in range(k):
                before, change = 0.0, 0.0
                for t in range(times + 1):
                    distance2 = 0.0
                    for a in range(3):
                        distance2 += (paths[k, t, a] - paths[m, t, a]) ** 2
                    distance = np.sqrt(distance2)
                    if t == 0:
                        before = distance
                    change = max(change, abs(distance - before))
                agree[k, m] = agree[m, k] = np.exp(-0.5 * change * change / (PARTING * PARTING * reach2))
        most, dominant = -1.0, 0
        for m in range(count):
            support = 0.0
            for k in range(count):
                support += weights[v, k] * agree[m, k]
            if support > most:
                most, dominant = support, m
        weights[v] *= agree[dominant]
        weights[v] /= weights[v].sum()


@njit(cache=True, nogil=True)
@no_type_check
def _move(bones, weights, points, rest, moved, turns, offsets):
    """Write the offsets of all vertices at one timestamp."""
    center, there, arm = np.zeros(3), np.zeros(3), np.zeros(3)
    covariance, turn, rotation = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    for v in range(points.shape[0]):
        center[:], there[:], covariance[:], turn[:] = 0, 0, 0, 0
        for k in range(bones.shape[1]):
            i, w = bones[v, k], weights[v, k]
            for a in range(3):
                center[a] += w * rest[i, a]
                there[a] += w * moved[i, a]
        size2 = 0.0
        for k in range(bones.shape[1]):
            i, w = bones[v, k], weights[v, k]
            for b in range(3):
                arm[b] = rest[i, b] - center[b]
                size2 += w * arm[b] * arm[b]
            for a in range(3):
                there_arm = w * (moved[i, a] - there[a])
                for b in range(3):
                    covariance[a, b] += there_arm * arm[b]
                    turn[a, b] += w * turns[i, a, b]
        own = OWN_ROTATION * size2 + 1e-12
        for a in range(3):
            for b in range(3):
                covariance[a, b] += own * turn[a, b]
        nearest_rotation(covariance, rotation)
        for a in range(3):
            offsets[v, a] = there[a] - points[v, a]
            for b in range(3):
                offsets[v, a] += rotation[a, b] * (points[v, b] - center[b])
