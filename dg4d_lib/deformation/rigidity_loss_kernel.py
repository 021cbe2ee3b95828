"""How far neighbors are moved against each other, and the gradient of it, in one pass over pairs of neighbors.

Buffers have time last, so that all moments of a pair are computed side by side.
"""

from functools import partial
from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import njit
from torch import Tensor
from torch.autograd.function import once_differentiable

from dg4d_lib.kernels.vectors import KERNEL
from dg4d_lib.kernels.workers import ranges, run

BLOCKS = 4  # of Gaussians, each with sums of its own
TINY = np.float32(1e-20)  # squared distance under which there is no direction


def rigidity_sum(
    means: Float[Tensor, "t n 3"],
    turns: Float[Tensor, "t n 3 3"],
    indices: Int[Tensor, "n k"],
    weights: Float[Tensor, "n k"],
) -> Float[Tensor, ""]:
    """Sum over pairs and steps of time of weighted distances; differentiable once, in means and turns.

    Args:
        means: at every moment, two or more.
        turns: rotation matrices.
        indices: neighbors of every Gaussian.
        weights: of the pairs.
    """
    total: Tensor = _RigiditySum.apply(means, turns, indices, weights)
    return total


class _RigiditySum(torch.autograd.Function):
    """The bridge to autograd: the gradient is found with the sum, and waits until it is asked for."""

    @staticmethod
    def forward(ctx: Any, means: Tensor, turns: Tensor, indices: Tensor, weights: Tensor) -> Tensor:
        places = means.detach().permute(1, 2, 0).contiguous().numpy()
        frames = turns.detach().permute(1, 2, 3, 0).contiguous().numpy()
        fixed = (places, frames, indices.numpy(), weights.numpy())
        parts = ranges(len(places), BLOCKS)
        sums = np.zeros(len(parts))
        grad_places = np.zeros((len(parts), *places.shape), np.float32)
        grad_frames = np.zeros_like(frames)
        run([partial(_pairs, *fixed, grad_places[i], grad_frames, sums[i : i + 1], *p) for i, p in enumerate(parts)])
        ctx.gradients = torch.from_numpy(grad_places.sum(0)), torch.from_numpy(grad_frames)
        return means.new_tensor(sums.sum())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, incoming: Tensor) -> tuple[Tensor, Tensor, None, None]:
        places, frames = ctx.gradients
        return incoming * places.permute(2, 0, 1), incoming * frames.permute(3, 0, 1, 2), None, None


@njit(**KERNEL)
@no_type_check
def _pairs(places, frames, indices, weights, grad_places, grad_frames, total, start, stop):
    times = places.shape[2]
    edge, local = np.empty((3, times), np.float32), np.empty((3, times), np.float32)
    pull = np.zeros((3, times + 1), np.float32)  # of the step before a moment; none before the first or after the last
    for own in range(start, stop):
        for k in range(indices.shape[1]):
            other, weight = indices[own, k], weights[own, k]
            _carry(places[own], places[other], frames[own], edge, local)
            total[0] += weight * _steps(local, weight, pull)
            _pull_back(frames[own], edge, pull, grad_places[own], grad_places[other], grad_frames[own])


@njit(**KERNEL)
@no_type_check
def _carry(own, other, turn, edge, local):
    """The edge to a neighbor, and as it is seen from the frame of its owner."""
    for t in range(edge.shape[1]):
        x, y, z = other[0, t] - own[0, t], other[1, t] - own[1, t], other[2, t] - own[2, t]
        edge[0, t], edge[1, t], edge[2, t] = x, y, z
        local[0, t] = turn[0, 0, t] * x + turn[1, 0, t] * y + turn[2, 0, t] * z
        local[1, t] = turn[0, 1, t] * x + turn[1, 1, t] * y + turn[2, 1, t] * z
        local[2, t] = turn[0, 2, t] * x + turn[1, 2, t] * y + turn[2, 2, t] * z


@njit(**KERNEL)
@no_type_check
def _steps(local, weight, pull):
    """Sum of the lengths of the steps, and their weighted directions."""
    total = np.float32(0)
    for t in range(local.shape[1] - 1):
        x, y, z = local[0, t + 1] - local[0, t], local[1, t + 1] - local[1, t], local[2, t + 1] - local[2, t]
        squared = x * x + y * y + z * z
        inverse = np.float32(1) / np.sqrt(squared) if squared > TINY else np.float32(0)
        total += squared * inverse
        slope = weight * inverse
        pull[0, t + 1], pull[1, t + 1], pull[2, t + 1] = slope * x, slope * y, slope * z
    return total


@njit(**KERNEL)
@no_type_check
def _pull_back(turn, edge, pull, grad_own, grad_other, grad_turn):
    """Add the gradient of one pair."""
    for t in range(edge.shape[1]):
        x, y, z = pull[0, t] - pull[0, t + 1], pull[1, t] - pull[1, t + 1], pull[2, t] - pull[2, t + 1]
        for row in range(3):
            push = turn[row, 0, t] * x + turn[row, 1, t] * y + turn[row, 2, t] * z
            grad_other[row, t] += push
            grad_own[row, t] -= push
            grad_turn[row, 0, t] += edge[row, t] * x
            grad_turn[row, 1, t] += edge[row, t] * y
            grad_turn[row, 2, t] += edge[row, t] * z
