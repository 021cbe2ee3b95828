"""Compiled HexPlane features and their gradient, in one pass over the points, sixteen channels at a time.

Spatial planes are read once per point instead of once per point and time; no intermediate result is written.
Buffers have the channels last: planes as [plane, row, column, channel], lines as [axis, cell, time, channel].
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
from torch.nn import functional

from dg4d_lib.kernels.compiling import njit
from dg4d_lib.kernels.simd import FLOAT, INT, KERNEL, LANES, LONG, SimdBuilder, Value, pointers
from dg4d_lib.kernels.workers import run_parallel, split_range, thread_count

SPATIAL_AXES = ((0, 1), (0, 2), (1, 2))  # xy, xz, yz: (column axis, row axis)
BLOCKS = 4  # blocks of points with separate gradient sums
BLOCK_BYTES = 1 << 26  # bound on these sums; larger planes use fewer blocks


def hexplane_features(
    coordinates: Float[Tensor, "n 3"], planes: Float[Tensor, "3 c r r"], lines: Float[Tensor, "3 t c r"]
) -> Float[Tensor, "t n c"]:
    """Return the product of the six samples for every point and time; differentiable once.

    Args:
        coordinates: in [-1, 1], between the centers of the first and the last cells; clamped outside, where their
            gradient is zero.
        planes: xy, xz and yz; rows are the second axis, columns the first; sampled bilinearly.
        lines: xt, yt and zt, already sampled at the times; sampled linearly.

    Returns:
        Features in the precision of the planes, computed in float32.
    """
    features: Tensor = _Features.apply(coordinates, planes.float(), lines.float())
    return features.to(planes.dtype)


class _Features(torch.autograd.Function):
    """Autograd function; channels are padded to a multiple of the vector width."""

    @staticmethod
    def forward(ctx: Any, coordinates: Tensor, planes: Tensor, lines: Tensor) -> Tensor:
        channels = planes.shape[1]
        plane_buffer = _padded(planes.permute(0, 2, 3, 1))
        line_buffer = _padded(lines.permute(0, 3, 1, 2))
        cells, weights = _cells(coordinates, planes.shape[-1])
        features = torch.empty(lines.shape[1], len(coordinates), plane_buffer.shape[-1])
        arrays = [tensor.numpy() for tensor in (cells, weights, plane_buffer, line_buffer)]
        parts = split_range(len(coordinates), thread_count())
        run_parallel([partial(_read, *arrays, features.numpy(), *part) for part in parts])
        ctx.arrays, ctx.channels = arrays, channels
        ctx.slope = (coordinates.abs() < 1) * (planes.shape[-1] - 1) / 2  # d weights / d coordinates
        return features[..., :channels]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, incoming: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        """Compute gradients per block of points and sixteen channels, independently of the number of threads."""
        buffers = ctx.arrays[2:]
        gradient = _padded(incoming).numpy()
        blocks = max(1, min(BLOCKS, BLOCK_BYTES // sum(buffer.nbytes for buffer in buffers)))
        parts = split_range(gradient.shape[1], blocks)
        partial_sums = [np.zeros((len(parts), *buffer.shape), np.float32) for buffer in buffers]
        grad_weights = np.empty((3, *gradient.shape[1:]), np.float32) if ctx.needs_input_grad[0] else None
        run_parallel(
            [
                partial(
                    _backward,
                    *ctx.arrays,
                    gradient,
                    *(array[i] for array in partial_sums),
                    grad_weights,
                    *part,
                    channel,
                )
                for i, part in enumerate(parts)
                for channel in range(0, gradient.shape[2], LANES)
            ]
        )
        sums = (torch.from_numpy(array.sum(0)) for array in partial_sums)
        planes, lines = (total[..., : ctx.channels] for total in sums)
        grad_coordinates = None if grad_weights is None else torch.from_numpy(grad_weights.sum(-1).T) * ctx.slope
        return grad_coordinates, planes.permute(0, 3, 1, 2), lines.permute(0, 2, 3, 1)


def _padded(tensor: Tensor) -> Tensor:
    """Return a contiguous copy whose last axis is zero-padded to a multiple of the vector width."""
    missing = -tensor.shape[-1] % LANES
    return (functional.pad(tensor, (0, missing)) if missing else tensor).contiguous()


def _cells(coordinates: Tensor, size: int) -> tuple[Int[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Return the left cell on each axis and the interpolation weight of its right neighbor."""
    position = ((coordinates.detach() + 1) / 2 * (size - 1)).clamp(0, size - 1)
    cells = position.floor().to(torch.int32).clamp(0, size - 2)
    return cells.contiguous(), (position - cells).float().contiguous()


@njit(**KERNEL)
@no_type_check
def _read(cells, weights, planes, lines, features, start, stop):
    size, times, channels = planes.shape[1], lines.shape[2], planes.shape[3]
    points = features.shape[1]
    for point in range(start, stop):
        for channel in range(0, channels, LANES):
            _read_point(cells, weights, planes, lines, features, point, channel, size, times, channels, points)


@njit(**KERNEL)
@no_type_check
def _backward(cells, weights, planes, lines, gradient, grad_planes, grad_lines, grad_weights, start, stop, channel):
    size, times, channels = planes.shape[1], lines.shape[2], planes.shape[3]
    points = gradient.shape[1]
    for point in range(start, stop):
        _backward_point(
            cells, weights, planes, lines, gradient, grad_planes, grad_lines, grad_weights,
            point, channel, size, times, channels, points,
        )  # fmt: skip


@intrinsic
@no_type_check
def _read_point(typing_context, cells, weights, planes, lines, features, point, channel, size, times, channels, points):
    """Compute sixteen channels of one point's features at all times."""
    scalars = [types.int64] * 6
    signature = types.void(cells, weights, planes, lines, features, *scalars)

    def generate(context, builder, signature, arguments):
        e = SimdBuilder(builder)
        data = pointers(context, builder, signature, arguments)
        sampler = _PointSampler(e, data, arguments[5:])
        first, second, third = sampler.spatial()
        product = e.multiply(e.multiply(first, second), third)

        def at_time(time, carried):
            x, y, z = sampler.temporal(time)
            e.store(data[4], sampler.feature_index(time), e.multiply(e.multiply(product, x), e.multiply(y, z)))
            return []

        e.loop(_long(0), arguments[8], [], at_time)
        return context.get_dummy_value()

    return signature, generate


@intrinsic
@no_type_check
def _backward_point(
    typing_context, cells, weights, planes, lines, gradient, grad_planes, grad_lines, grad_weights,
    point, channel, size, times, channels, points,
):  # fmt: skip
    """Add the gradient of one point and sixteen channels to the planes and lines that it sampled.

    The gradient of its interpolation weights is written per channel, unless `grad_weights` is None.
    """
    scalars = [types.int64] * 6
    signature = types.void(cells, weights, planes, lines, gradient, grad_planes, grad_lines, grad_weights, *scalars)
    axes = () if isinstance(grad_weights, types.NoneType) else range(3)

    def generate(context, builder, signature, arguments):
        e = SimdBuilder(builder)
        data = pointers(context, builder, signature, arguments)
        sampler = _PointSampler(e, data, arguments[8:])
        first, second, third = sampler.spatial()
        product = e.multiply(e.multiply(first, second), third)

        def add(array, index, weight, value):
            e.store(array, index, e.fma(weight, value, e.load(array, index)))

        def at_time(time, carried):
            x, y, z = sampler.temporal(time)
            incoming = e.load(data[4], sampler.feature_index(time))
            scaled = e.multiply(incoming, product)
            xy = e.multiply(x, y)
            parts = (e.multiply(e.multiply(scaled, y), z), e.multiply(e.multiply(scaled, x), z), e.multiply(scaled, xy))
            for axis, part in enumerate(parts):
                for index, weight in sampler.ends(axis, time):
                    add(data[6], index, weight, part)
            slopes = [e.fma(parts[axis], sampler.line_slope(axis, time), carried[1 + axis]) for axis in axes]
            return [e.fma(incoming, e.multiply(xy, z), carried[0]), *slopes]

        total, *slopes = e.loop(_long(0), arguments[11], [e.constant(0)] * (1 + len(axes)), at_time)
        others = (e.multiply(second, third), e.multiply(first, third), e.multiply(first, second))
        for plane, other in enumerate(others):
            part = e.multiply(total, other)
            for index, weight in sampler.corners(plane):
                add(data[5], index, weight, part)
            for axis, slope in sampler.plane_slopes(plane) if axes else ():
                slopes[axis] = e.fma(part, slope, slopes[axis])
        for axis in axes:
            e.store(data[7], sampler.weight_index(axis), slopes[axis])
        return context.get_dummy_value()

    return signature, generate


class _PointSampler:
    """Cell indices and interpolation weights of one point, as LLVM values."""

    def __init__(self, e: SimdBuilder, data: Sequence[Value], scalars: Sequence[Value]) -> None:
        self.e, self.planes, self.lines = e, data[2], data[3]
        self.point, self.channel, self.size, self.times, self.channels, self.points = scalars
        builder = e.builder
        base = builder.mul(self.point, _long(3))
        indices = [builder.add(base, _long(axis)) for axis in range(3)]
        self.cells = [builder.sext(e.load(data[0], index, INT), LONG) for index in indices]
        self.right = [e.splat(e.load(data[1], index, FLOAT)) for index in indices]
        self.left = [e.subtract(e.constant(1), weight) for weight in self.right]

    def corners(self, plane: int) -> list[tuple[Value, Value]]:
        """Return index and weight of the four cells of a spatial plane."""
        builder = self.e.builder
        column, row = SPATIAL_AXES[plane]
        terms = []
        for down, row_weight in enumerate((self.left[row], self.right[row])):
            line = builder.add(builder.mul(self.size, _long(plane)), builder.add(self.cells[row], _long(down)))
            for along, column_weight in enumerate((self.left[column], self.right[column])):
                cell = builder.add(builder.add(builder.mul(line, self.size), self.cells[column]), _long(along))
                index = builder.add(builder.mul(cell, self.channels), self.channel)
                terms.append((index, self.e.multiply(row_weight, column_weight)))
        return terms

    def ends(self, axis: int, time: Value) -> list[tuple[Value, Value]]:
        """Return index and weight of the two cells of a line."""
        builder = self.e.builder
        terms = []
        for along, weight in enumerate((self.left[axis], self.right[axis])):
            cell = builder.add(builder.mul(self.size, _long(axis)), builder.add(self.cells[axis], _long(along)))
            row = builder.add(builder.mul(cell, self.times), time)
            terms.append((builder.add(builder.mul(row, self.channels), self.channel), weight))
        return terms

    def feature_index(self, time: Value) -> Value:
        """Return the index of the point's features at a time."""
        return self._index(time)

    def weight_index(self, axis: int) -> Value:
        """Return the index of the gradient of the point's interpolation weight on an axis."""
        return self._index(_long(axis))

    def _index(self, row: Value) -> Value:
        builder = self.e.builder
        index = builder.add(builder.mul(row, self.points), self.point)
        return builder.add(builder.mul(index, self.channels), self.channel)

    def spatial(self) -> list[Value]:
        """Return the samples of the three spatial planes."""
        return [self._sample(self.planes, self.corners(plane)) for plane in range(3)]

    def temporal(self, time: Value) -> list[Value]:
        """Return the samples of the three lines at a time."""
        return [self._sample(self.lines, self.ends(axis, time)) for axis in range(3)]

    def plane_slopes(self, plane: int) -> list[tuple[int, Value]]:
        """Return (axis, derivative of a spatial plane's sample in the interpolation weight) for its two axes."""
        e = self.e
        column, row = SPATIAL_AXES[plane]
        above, above_right, below, below_right = (e.load(self.planes, index) for index, _ in self.corners(plane))
        along = self._between(row, e.subtract(above_right, above), e.subtract(below_right, below))
        down = self._between(column, e.subtract(below, above), e.subtract(below_right, above_right))
        return [(column, along), (row, down)]

    def line_slope(self, axis: int, time: Value) -> Value:
        """Return the derivative of a line's sample in the interpolation weight of its axis."""
        left, right = (self.e.load(self.lines, index) for index, _ in self.ends(axis, time))
        return self.e.subtract(right, left)

    def _between(self, axis: int, left: Value, right: Value) -> Value:
        return self.e.fma(self.right[axis], right, self.e.multiply(self.left[axis], left))

    def _sample(self, array: Value, terms: list[tuple[Value, Value]]) -> Value:
        (index, weight), *others = terms
        total = self.e.multiply(weight, self.e.load(array, index))
        for index, weight in others:
            total = self.e.fma(weight, self.e.load(array, index), total)
        return total


def _long(value: int) -> Value:
    return ir.Constant(LONG, value)
