"""Compiled local rigidity loss and its gradient, in one pass over pairs of neighbors.

Time is the last axis of all buffers, so that the timestamps of a pair are vectorized.
"""

from functools import partial
from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import njit
from torch import Tensor
from torch.autograd.function import once_differentiable

from dg4d_lib.kernels.simd import KERNEL
from dg4d_lib.kernels.workers import run_parallel, split_range

BLOCKS = 4  # blocks of Gaussians with separate sums; fixed, so that the result does not depend on threads
TINY = np.float32(1e-20)  # squared distance below which the gradient is zero


def rigidity_sum(
    means: Float[Tensor, "t n 3"],
    rotations: Float[Tensor, "t n 3 3"],
    indices: Int[Tensor, "n k"],
    weights: Float[Tensor, "n k"],
) -> Float[Tensor, ""]:
    """Return the sum over pairs and frame transitions of weighted distances.

    Differentiable once, in means and rotations.

    Args:
        means: at two or more timestamps.
        rotations: rotation matrices.
        indices: neighbors of every Gaussian.
        weights: of the pairs.
    """
    total: Tensor = _RigiditySum.apply(means, rotations, indices, weights)
    return total


class _RigiditySum(torch.autograd.Function):
    """Autograd function; the forward pass computes the gradient too, and the backward pass scales it."""

    @staticmethod
    def forward(ctx: Any, means: Tensor, rotations: Tensor, indices: Tensor, weights: Tensor) -> Tensor:
        points = means.detach().permute(1, 2, 0).contiguous().numpy()
        frames = rotations.detach().permute(1, 2, 3, 0).contiguous().numpy()
        inputs = (points, frames, indices.numpy(), weights.numpy())
        parts = split_range(len(points), BLOCKS)
        sums = np.zeros(len(parts))
        grad_points = np.zeros((len(parts), *points.shape), np.float32)
        grad_frames = np.zeros_like(frames)
        run_parallel(
            [partial(_pairs, *inputs, grad_points[i], grad_frames, sums[i : i + 1], *p) for i, p in enumerate(parts)]
        )
        ctx.gradients = torch.from_numpy(grad_points.sum(0)), torch.from_numpy(grad_frames)
        return means.new_tensor(sums.sum())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, incoming: Tensor) -> tuple[Tensor, Tensor, None, None]:
        points, frames = ctx.gradients
        return incoming * points.permute(2, 0, 1), incoming * frames.permute(3, 0, 1, 2), None, None


@njit(**KERNEL)
@no_type_check
def _pairs(points, frames, indices, weights, grad_points, grad_frames, total, start, stop):
    times = points.shape[2]
    edge, local = np.empty((3, times), np.float32), np.empty((3, times), np.float32)
    slopes = np.zeros((3, times + 1), np.float32)  # of the transition before a timestamp; zero at both ends
    for own in range(start, stop):
        for k in range(indices.shape[1]):
            other, weight = indices[own, k], weights[own, k]
            _to_local(points[own], points[other], frames[own], edge, local)
            total[0] += weight * _transitions(local, weight, slopes)
            _backward(frames[own], edge, slopes, grad_points[own], grad_points[other], grad_frames[own])


@njit(**KERNEL)
@no_type_check
def _to_local(own, other, rotation, edge, local):
    """Compute the offset of a neighbor in world axes and in the Gaussian's own axes."""
    for t in range(edge.shape[1]):
        x, y, z = other[0, t] - own[0, t], other[1, t] - own[1, t], other[2, t] - own[2, t]
        edge[0, t], edge[1, t], edge[2, t] = x, y, z
        local[0, t] = rotation[0, 0, t] * x + rotation[1, 0, t] * y + rotation[2, 0, t] * z
        local[1, t] = rotation[0, 1, t] * x + rotation[1, 1, t] * y + rotation[2, 1, t] * z
        local[2, t] = rotation[0, 2, t] * x + rotation[1, 2, t] * y + rotation[2, 2, t] * z


@njit(**KERNEL)
@no_type_check
def _transitions(local, weight, slopes):
    """Return the summed lengths of the transitions; store their weighted directions."""
    total = np.float32(0)
    for t in range(local.shape[1] - 1):
        x, y, z = local[0, t + 1] - local[0, t], local[1, t + 1] - local[1, t], local[2, t + 1] - local[2, t]
        squared = x * x + y * y + z * z
        inverse = np.float32(1) / np.sqrt(squared) if squared > TINY else np.float32(0)
        total += squared * inverse
        slope = weight * inverse
        slopes[0, t + 1], slopes[1, t + 1], slopes[2, t + 1] = slope * x, slope * y, slope * z
    return total


@njit(**KERNEL)
@no_type_check
def _backward(rotation, edge, slopes, grad_own, grad_other, grad_rotation):
    """Add the gradient of one pair."""
    for t in range(edge.shape[1]):
        x, y, z = slopes[0, t] - slopes[0, t + 1], slopes[1, t] - slopes[1, t + 1], slopes[2, t] - slopes[2, t + 1]
        for row in range(3):
            gradient = rotation[row, 0, t] * x + rotation[row, 1, t] * y + rotation[row, 2, t] * z
            grad_other[row, t] += gradient
            grad_own[row, t] -= gradient
            grad_rotation[row, 0, t] += edge[row, t] * x
            grad_rotation[row, 1, t] += edge[row, t] * y
            grad_rotation[row, 2, t] += edge[row, t] * z
