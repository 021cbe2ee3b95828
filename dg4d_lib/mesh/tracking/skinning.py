"""One surface for all times: vertices ride the Gaussians around them.

A vertex moves with the rigid motion that fits its neighborhood best (moving least squares with rotations: Schaefer et
al. 2006, section 3; Mueller et al. 2005). Both the centers of the Gaussians and their own rotations say how the
neighborhood turns (oriented particles: Mueller and Chentanez 2011). Neighbors that leave the company of the one that
carries most, as one leg leaves the other, carry little.
"""

from functools import partial
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import njit
from scipy.spatial import cKDTree
from torch import Tensor

from dg4d_lib.deformation.interface import Displacement
from dg4d_lib.errors import BadInput
from dg4d_lib.gaussians.cloud import Gaussians
from dg4d_lib.geometry.quaternion import rotation_matrix
from dg4d_lib.kernels.workers import run

NEIGHBORS = 24  # Gaussians that carry a vertex
FAINT = 0.005  # less opaque Gaussians carry nothing, their motion is not seen
FALLBACK = 0.01  # weight of mere nearness against that of density
THINNEST = 0.25  # of the neighborhood's size: flat Gaussians carry what is near, not only what lies in their plane
PARTING = 0.5  # of the neighborhood's radius: standard deviation of how a carrier's distance to the main one may change
OWN_ROTATION = 0.5  # weight of the Gaussians' own rotations, per squared size of the neighborhood
SWEEPS = 6  # of Jacobi; four by four needs five for full precision


def skin_vertices(
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
    moved = (rest.means + displacement.means.double().cpu()).numpy()
    carriers, weights = (part.numpy() for part in _carriers(points, rest))
    _keep_company(carriers, weights, points.numpy(), rest.means.numpy(), moved)
    back = rotation_matrix(rest.quats).mT
    offsets = np.empty((len(moved), len(points), 3))

    def move(time: int) -> None:
        turns = rotation_matrix(rest.quats + displacement.quats[time].double().cpu()) @ back
        _move(carriers, weights, points.numpy(), rest.means.numpy(), moved[time], turns.numpy(), offsets[time])

    run([partial(move, time) for time in range(len(offsets))])
    return torch.from_numpy(offsets).to(vertices)


def _carriers(points: Float[Tensor, "v 3"], rest: Gaussians) -> tuple[Int[Tensor, "v k"], Float[Tensor, "v k"]]:
    """The Gaussians that carry every vertex, and their weights with sum 1: their shares of the density there."""
    shown = torch.nonzero(rest.opacities > FAINT)[:, 0]
    if len(shown) == 0:
        shown = torch.arange(len(rest))
    count = min(NEIGHBORS, len(shown))
    found = cKDTree(rest.means[shown].numpy()).query(points.numpy(), k=range(1, count + 1))
    distance, nearest = (torch.from_numpy(np.asarray(a)) for a in found)
    carriers = shown[nearest]
    reach = distance[:, -1:].clamp_min(1e-9)
    axes = rotation_matrix(rest.quats)[carriers]
    scales = rest.scales[carriers].maximum(THINNEST * reach[..., None])
    arms = points[:, None] - rest.means[carriers]
    local = (arms[..., None, :] @ axes)[..., 0, :] / scales
    density = torch.exp(-0.5 * local.square().sum(-1))
    nearness = torch.exp(-4.5 * (distance / reach).square())  # three standard deviations at the last neighbor
    weights = rest.opacities[carriers] * (density + FALLBACK * nearness)
    return carriers, weights / weights.sum(-1, keepdim=True)


@njit(cache=True, nogil=True)
@no_type_check
def _keep_company(carriers, weights, points, rest, moved):
    """Keep to the largest company: carriers whose distance to its middle one changes over time carry less.

    The middle one is the carrier that most weight goes along with. Rows of weights sum to 1 again.
    """
    count = carriers.shape[1]
    agree = np.empty((count, count))
    for v in range(carriers.shape[0]):
        reach2 = 1e-18
        for i in carriers[v]:
            reach2 = max(reach2, np.square(rest[i] - points[v]).sum())
        agree[:] = 1.0
        for k in range(count):
            for m in range(k):
                i, j, change = carriers[v, k], carriers[v, m], 0.0
                before = np.sqrt(np.square(rest[i] - rest[j]).sum())
                for t in range(moved.shape[0]):
                    after = 0.0
                    for a in range(3):
                        after += (moved[t, i, a] - moved[t, j, a]) ** 2
                    change = max(change, abs(np.sqrt(after) - before))
                agree[k, m] = agree[m, k] = np.exp(-0.5 * change * change / (PARTING * PARTING * reach2))
        most, middle = -1.0, 0
        for m in range(count):
            company = 0.0
            for k in range(count):
                company += weights[v, k] * agree[m, k]
            if company > most:
                most, middle = company, m
        weights[v] *= agree[middle]
        weights[v] /= weights[v].sum()


@njit(cache=True, nogil=True)
@no_type_check
def _move(carriers, weights, points, rest, moved, turns, offsets):
    """Offsets of all vertices at one time."""
    center, there, arm = np.zeros(3), np.zeros(3), np.zeros(3)
    moments, turn, rotation = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    for v in range(points.shape[0]):
        center[:], there[:], moments[:], turn[:] = 0, 0, 0, 0
        for k in range(carriers.shape[1]):
            i, w = carriers[v, k], weights[v, k]
            for a in range(3):
                center[a] += w * rest[i, a]
                there[a] += w * moved[i, a]
        size2 = 0.0
        for k in range(carriers.shape[1]):
            i, w = carriers[v, k], weights[v, k]
            for b in range(3):
                arm[b] = rest[i, b] - center[b]
                size2 += w * arm[b] * arm[b]
            for a in range(3):
                there_arm = w * (moved[i, a] - there[a])
                for b in range(3):
                    moments[a, b] += there_arm * arm[b]
                    turn[a, b] += w * turns[i, a, b]
        own = OWN_ROTATION * size2 + 1e-12
        for a in range(3):
            for b in range(3):
                moments[a, b] += own * turn[a, b]
        _nearest_rotation(moments, rotation)
        for a in range(3):
            offsets[v, a] = there[a] - points[v, a]
            for b in range(3):
                offsets[v, a] += rotation[a, b] * (points[v, b] - center[b])


@njit(cache=True, nogil=True)
@no_type_check
def _nearest_rotation(m, rotation):
    """The proper rotation nearest to a matrix: an eigenvector (Horn 1987), found by Jacobi sweeps."""
    n = np.zeros((4, 4))
    n[0, 0], n[1, 1] = m[0, 0] + m[1, 1] + m[2, 2], m[0, 0] - m[1, 1] - m[2, 2]
    n[2, 2], n[3, 3] = m[1, 1] - m[0, 0] - m[2, 2], m[2, 2] - m[0, 0] - m[1, 1]
    n[0, 1], n[0, 2], n[0, 3] = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    n[1, 2], n[1, 3], n[2, 3] = m[1, 0] + m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2]
    vectors = np.eye(4)
    for _ in range(SWEEPS):
        for p in range(3):
            for q in range(p + 1, 4):
                if abs(n[p, q]) < 1e-300:
                    continue
                tau = (n[q, q] - n[p, p]) / (2 * n[p, q])
                t = (1.0 if tau >= 0 else -1.0) / (abs(tau) + np.sqrt(1 + tau * tau))
                c = 1 / np.sqrt(1 + t * t)
                s = t * c
                n[p, p] -= t * n[p, q]
                n[q, q] += t * n[p, q]
                n[p, q] = 0.0
                for r in range(4):
                    if r not in (p, q):
                        pr, qr = (min(p, r), max(p, r)), (min(q, r), max(q, r))
                        x, y = n[pr], n[qr]
                        n[pr], n[qr] = c * x - s * y, s * x + c * y
                    x, y = vectors[r, p], vectors[r, q]
                    vectors[r, p], vectors[r, q] = c * x - s * y, s * x + c * y
    best = 0
    for p in range(1, 4):
        if n[p, p] > n[best, best]:
            best = p
    w, x, y, z = vectors[0, best], vectors[1, best], vectors[2, best], vectors[3, best]
    rotation[0, 0], rotation[1, 1] = 1 - 2 * (y * y + z * z), 1 - 2 * (x * x + z * z)
    rotation[2, 2] = 1 - 2 * (x * x + y * y)
    rotation[0, 1], rotation[1, 0] = 2 * (x * y - w * z), 2 * (x * y + w * z)
    rotation[0, 2], rotation[2, 0] = 2 * (x * z + w * y), 2 * (x * z - w * y)
    rotation[1, 2], rotation[2, 1] = 2 * (y * z - w * x), 2 * (y * z + w * x)
