"""Compiled local rigidity loss and its gradient, in one pass over pairs of neighbors.

The lanes of a vector are consecutive timestamps of one Gaussian. Vectors overlap by one timestamp, so that each has the
transitions between its own lanes and depends on no other.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from torch import Tensor
from torch.autograd.function import once_differentiable

from dg4d_lib.kernels.compiling import njit
from dg4d_lib.kernels.simd import FLOAT, INT, KERNEL, LANES, LONG, SimdBuilder, Value, pointers
from dg4d_lib.kernels.workers import Scratch, run_parallel, split_range, thread_count

BLOCKS = 4  # blocks of Gaussians with separate sums; fixed, so that the result does not depend on threads
TINY = 1e-20  # squared distance below which the gradient is zero
_STEPS = LANES - 1  # transitions in a vector
_FIELDS = 7  # mean and quaternion of a Gaussian


def rigidity_sum(
    means: Float[Tensor, "t n 3"],
    quats: Float[Tensor, "t n 4"],
    indices: Int[Tensor, "n k"],
    weights: Float[Tensor, "n k"],
) -> Float[Tensor, ""]:
    """Return the sum over pairs and frame transitions of weighted distances.

    Differentiable once, in means and quaternions.

    Args:
        means: at two or more timestamps.
        quats: rotations wxyz, any norm from 1e-10 to 1e18.
        indices: neighbors of every Gaussian.
        weights: of the pairs.
    """
    total: Tensor = _RigiditySum.apply(means, quats, indices, weights)
    return total


class _RigiditySum(torch.autograd.Function):
    """Autograd function; the forward pass computes the gradient too, and the backward pass scales it."""

    @staticmethod
    def forward(ctx: Any, means: Tensor, quats: Tensor, indices: Tensor, weights: Tensor) -> Tensor:
        given = means.detach().contiguous().numpy(), quats.detach().contiguous().numpy()
        pairs = indices.to(torch.int32).contiguous().numpy(), weights.contiguous().numpy()
        times, count = means.shape[:2]
        vectors = -(-(times - 1) // _STEPS)
        masks = np.zeros((vectors, LANES), np.float32)  # 1 for lanes from which a transition starts
        masks.reshape(-1)[[step + step // _STEPS for step in range(times - 1)]] = 1
        scratch, shape = Scratch(), (count, _FIELDS, LANES)
        state, grad_own = ([scratch.empty(shape) for _ in range(vectors)] for _ in range(2))
        parts, threads = split_range(count, BLOCKS), thread_count()
        grad_others = [scratch.empty((len(parts), count, 3, LANES)) for _ in range(vectors)]
        sums = np.zeros((vectors, len(parts)))
        run_parallel(
            [
                partial(_gather, *given, state[v], v * _STEPS, *p)
                for v in range(vectors)
                for p in split_range(count, threads)
            ]
        )
        run_parallel(
            [
                partial(_pairs, state[v], *pairs, masks[v], grad_own[v], grad_others[v][i], sums[v, i : i + 1], *p)
                for v in range(vectors)
                for i, p in enumerate(parts)
            ]
        )
        gradients = np.zeros_like(given[0]), np.zeros_like(given[1])

        def scatter(start: int, stop: int) -> None:
            for v in range(vectors):
                _scatter(grad_own[v], grad_others[v], *gradients, v * _STEPS, start, stop)

        run_parallel([partial(scatter, *p) for p in split_range(count, threads)])
        ctx.gradients = tuple(map(torch.from_numpy, gradients))
        return means.new_tensor(sums.sum())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, incoming: Tensor) -> tuple[Tensor, Tensor, None, None]:
        grad_means, grad_quats = ctx.gradients
        return incoming * grad_means, incoming * grad_quats, None, None


@njit(**KERNEL)
@no_type_check
def _gather(means, quats, state, first, start, stop):
    """Fill the lanes of Gaussians start..stop from a timestamp on; those after the last timestamp repeat it."""
    last = len(means) - 1
    for g in range(start, stop):
        for lane in range(LANES):
            time = min(first + lane, last)
            for axis in range(3):
                state[g, axis, lane] = means[time, g, axis]
            for axis in range(4):
                state[g, 3 + axis, lane] = quats[time, g, axis]


@njit(**KERNEL)
@no_type_check
def _scatter(grad_own, grad_others, grad_means, grad_quats, first, start, stop):
    """Add the gradients of the lanes of Gaussians start..stop to those of their timestamps."""
    lanes = min(LANES, len(grad_means) - first)
    for g in range(start, stop):
        for lane in range(lanes):
            for axis in range(3):
                total = grad_own[g, axis, lane]
                for part in range(len(grad_others)):
                    total += grad_others[part, g, axis, lane]
                grad_means[first + lane, g, axis] += total
            for axis in range(4):
                grad_quats[first + lane, g, axis] += grad_own[g, 3 + axis, lane]


@njit(**KERNEL)
@no_type_check
def _pairs(state, indices, weights, mask, grad_own, grad_others, total, start, stop):
    grad_others[:] = 0
    for own in range(start, stop):
        total[0] += _neighborhood(state, indices, weights, mask, grad_own, grad_others, own, indices.shape[1])


@intrinsic
@no_type_check
def _neighborhood(typing_context, state, indices, weights, mask, grad_own, grad_others, own, count):
    """Return the weighted distances of a Gaussian's pairs; store its gradient, add those of its neighbors."""
    arrays = (state, indices, weights, mask, grad_own, grad_others)
    signature = types.float32(*arrays, types.int64, types.int64)

    def generate(context, builder, signature, arguments):
        e = SimdBuilder(builder)
        data = pointers(context, builder, signature, arguments)
        own, count = arguments[6:]
        place = _row(builder, own, _FIELDS)
        mean, quat = _load(e, data[0], place, 3), _load(e, data[0], _field(builder, place, 3), 4)
        matrix, unit, inverse_norm = _rotation(e, quat)
        starts = e.load(data[3], _long(0))

        def pair(k, carried):
            distance, *sums = carried
            other = builder.sext(e.load(data[1], k, INT), LONG)
            weight = e.multiply(starts, e.splat(e.load(data[2], k, FLOAT)))
            there = _load(e, data[0], _row(builder, other, _FIELDS), 3)
            edge = [e.subtract(*both) for both in zip(there, mean, strict=True)]
            local = [_dot(e, column, edge) for column in zip(*matrix, strict=True)]
            steps = [e.subtract(e.shift(value, 1), value) for value in local]
            squared = _dot(e, steps, steps)
            length = e.call("sqrt", squared)
            moves = e.less(e.constant(TINY), squared)
            factor = e.select(moves, e.multiply(weight, e.reciprocal(length)), e.constant(0))
            slopes = [e.multiply(factor, step) for step in steps]
            pull = [e.subtract(e.shift(slope, -1), slope) for slope in slopes]
            forces = [_dot(e, row, pull) for row in matrix]
            for axis, force in enumerate(forces):
                index = _field(builder, _row(builder, other, 3), axis)
                e.store(data[5], index, e.add(e.load(data[5], index), force))
            turned = [e.fma(edge[i], pull[j], sums[3 + 3 * i + j]) for i in range(3) for j in range(3)]
            own_forces = [e.subtract(total, force) for total, force in zip(sums[:3], forces, strict=True)]
            return [e.fma(weight, length, distance), *own_forces, *turned]

        first = builder.mul(own, count)
        distance, *sums = e.loop(first, builder.add(first, count), [e.constant(0)] * 13, pair)
        for axis, value in enumerate([*sums[:3], *_quat_gradient(e, unit, inverse_norm, sums[3:])]):
            e.store(data[4], _field(builder, place, axis), value)
        return e.sum(distance)

    return signature, generate


def _rotation(e: SimdBuilder, quat: Sequence[Value]) -> tuple[list[list[Value]], list[Value], Value]:
    """Return the rotation matrix by rows, the unit quaternion, and the inverse norm of the given one."""
    inverse = e.reciprocal(e.call("sqrt", _dot(e, quat, quat)))
    w, x, y, z = unit = [e.multiply(value, inverse) for value in quat]
    one, two = e.constant(1), e.constant(2)

    def twice(a: Value, b: Value, c: Value, d: Value) -> Value:
        return e.multiply(two, e.fma(a, b, e.multiply(c, d)))

    minus_w = e.negate(w)
    matrix = [
        [e.subtract(one, twice(y, y, z, z)), twice(x, y, minus_w, z), twice(x, z, w, y)],
        [twice(x, y, w, z), e.subtract(one, twice(x, x, z, z)), twice(y, z, minus_w, x)],
        [twice(x, z, minus_w, y), twice(y, z, w, x), e.subtract(one, twice(x, x, y, y))],
    ]
    return matrix, unit, inverse


def _quat_gradient(e: SimdBuilder, unit: Sequence[Value], inverse: Value, matrix: Sequence[Value]) -> list[Value]:
    """Propagate the gradient of a rotation matrix, by rows, to the quaternion of any norm."""
    w, x, y, z = unit
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = matrix
    a, b, c = e.subtract(m21, m12), e.subtract(m02, m20), e.subtract(m10, m01)
    d, f, g = e.add(m01, m10), e.add(m02, m20), e.add(m12, m21)
    minus_two = e.constant(-2)
    diagonals = [e.multiply(minus_two, e.add(*pair)) for pair in ((m11, m22), (m00, m22), (m00, m11))]
    halves = [
        _dot(e, (x, y, z), (a, b, c)),
        _dot(e, (w, x, y, z), (a, diagonals[0], d, f)),
        _dot(e, (w, x, y, z), (b, d, diagonals[1], g)),
        _dot(e, (w, x, y, z), (c, f, g, diagonals[2])),
    ]
    along = _dot(e, unit, halves)
    scale = e.multiply(e.constant(2), inverse)
    return [
        e.multiply(scale, e.subtract(half, e.multiply(value, along))) for half, value in zip(halves, unit, strict=True)
    ]


def _dot(e: SimdBuilder, first: Sequence[Value], second: Sequence[Value]) -> Value:
    (a, b), *others = zip(first, second, strict=True)
    total = e.multiply(a, b)
    for a, b in others:
        total = e.fma(a, b, total)
    return total


def _load(e: SimdBuilder, array: Value, place: Value, fields: int) -> list[Value]:
    return [e.load(array, _field(e.builder, place, field)) for field in range(fields)]


def _row(builder: Value, gaussian: Value, fields: int) -> Value:
    """Return the index of the first field of a Gaussian."""
    return builder.mul(gaussian, _long(fields * LANES))


def _field(builder: Value, row: Value, field: int) -> Value:
    return builder.add(row, _long(field * LANES))


def _long(value: int) -> Value:
    return ir.Constant(LONG, value)
