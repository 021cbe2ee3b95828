"""Inner loops of alpha blending as LLVM vectors, sixteen pixels at a time.

A tile is stored in planes of row pairs, with the two rows interleaved: a vector of 16 floats is 8 x 2 pixels and may
start at any column. `cover` lists the vectors of a Gaussian, `blend_list` and `blend_list_backward` process a list.
"""

from typing import no_type_check

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from dg4d_lib.kernels.simd import FLOAT, FLOATS, INT, INTS, LANES, LONG, SimdBuilder, Value, pointers
from dg4d_lib.rasterizer.cpu_bins import TILE
from dg4d_lib.rasterizer.cpu_project import (
    BLUE,
    DEPTH,
    EXTENT_Y,
    GRAD_FIELDS,
    GREEN,
    LOG_OPACITY,
    MEAN2D_X,
    MEAN2D_Y,
    RECORD,
    RED,
    ROW_LOSS,
    ROW_REACH,
    ROW_SLOPE,
    WHITEN_A,
    WHITEN_B,
    WHITEN_C,
)
from dg4d_lib.rasterizer.interface import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE

COLUMNS = LANES // 2  # pixel columns of a vector
PLANE_SHAPE = (TILE // 2, TILE + COLUMNS, 2)  # row pairs; a vector may extend past the tile's right edge
STRIDE = 2 * (TILE + COLUMNS)  # floats of a row pair
PLANE = STRIDE * TILE // 2
FORWARD_PLANES = 5  # transmittance (negative once stopped), red, green, blue, depth
BACKWARD_PLANES = 6  # transmittance, loss gradient from behind, gradients of red, green, blue, depth
MAX_VECTORS = (TILE // 2) * (TILE // COLUMNS)  # per Gaussian and tile
OVERRUN = TILE // COLUMNS  # vectors that `cover` may write past the new length

_LANE_COLUMN = [lane >> 1 for lane in range(LANES)]
_LANE_ROW = [lane & 1 for lane in range(LANES)]
_MIN_LOG_ALPHA = float(np.log2(MIN_ALPHA))


@intrinsic
@no_type_check
def cover(typing_context, records, g, left, top, positions, us, vs, length):  # noqa: PLR0915 - code of one intrinsic
    """Append the vectors that cover Gaussian g's ellipse inside a tile; return the new length.

    A vector is the position of its first pixel in a plane and its whitened coordinates (u, v). Eight row pairs are
    computed at once: the span of each row by a square root, then the union of the spans of a pair.
    """
    signature = types.int64(records, types.int64, types.float32, types.float32, positions, us, vs, types.int64)

    def generate(context, builder, signature, arguments):
        e = SimdBuilder(builder)
        data = pointers(context, builder, signature, arguments)
        record, base = data[0], builder.mul(arguments[1], _long(RECORD))

        def scalar(field):
            return e.load(record, builder.add(base, _long(field)), FLOAT)

        half = _float(0.5)
        x = builder.fsub(builder.fsub(scalar(MEAN2D_X), arguments[2]), half)
        y = builder.fsub(builder.fsub(scalar(MEAN2D_Y), arguments[3]), half)
        extent, a = scalar(EXTENT_Y), scalar(WHITEN_A)
        slope, reach, loss = (e.splat(scalar(field)) for field in (ROW_SLOPE, ROW_REACH, ROW_LOSS))
        broadcast_a, broadcast_b, broadcast_c = (e.splat(scalar(field)) for field in (WHITEN_A, WHITEN_B, WHITEN_C))
        center = e.splat(x)

        def pair(edge):
            inside = e.minimum(e.maximum(edge, _float(0)), _float(TILE - 1))
            return builder.ashr(builder.fptosi(inside, INT), _int(1))

        first = pair(builder.fsub(y, extent))
        last = builder.add(pair(builder.fadd(y, extent)), _int(1))
        eight = ir.VectorType(FLOAT, TILE // COLUMNS)
        step = e.splat(builder.fmul(a, _float(COLUMNS)), TILE // COLUMNS)
        ramp = builder.fmul(step, ir.Constant(eight, [float(i) for i in range(TILE // COLUMNS)]))
        jumps = ir.Constant(ir.VectorType(INT, TILE // COLUMNS), [2 * COLUMNS * i for i in range(TILE // COLUMNS)])
        spill = [cgutils.alloca_once(builder, kind) for kind in (INTS, INTS, FLOATS, FLOATS)]

        def rows(top_pair, carried):
            row = e.splat(builder.sitofp(builder.shl(top_pair, _int(1)), FLOAT))
            dy = e.add(e.constant([float(lane) for lane in range(LANES)]), e.subtract(row, e.splat(y)))
            squared = e.fma(e.negate(e.multiply(dy, dy)), loss, reach)
            touched = e.less(e.constant(0), squared)
            width = e.call("sqrt", e.maximum(squared, e.constant(0)))
            middle = e.fma(dy, slope, center)
            low = e.select(touched, e.subtract(middle, width), e.constant(1e6))
            high = e.select(touched, e.add(middle, width), e.constant(-1e6))
            partner = ir.Constant(INTS, [lane ^ 1 for lane in range(LANES)])
            low = e.minimum(low, builder.shuffle_vector(low, low, partner))
            high = e.maximum(high, builder.shuffle_vector(high, high, partner))
            low = e.minimum(e.maximum(e.call("ceil", low), e.constant(0)), e.constant(TILE))
            high = e.maximum(e.minimum(e.call("floor", high), e.constant(TILE - 1)), e.constant(-TILE))
            start = builder.fptosi(low, INTS)
            pixels = builder.sub(builder.fptosi(high, INTS), start)
            count = builder.ashr(builder.add(pixels, e.integers(COLUMNS)), e.integers(COLUMNS.bit_length() - 1))
            count = builder.select(builder.icmp_signed("<", count, e.integers(0)), e.integers(0), count)
            position = builder.add(
                e.integers([(lane >> 1) * STRIDE for lane in range(LANES)]),
                e.splat(builder.mul(top_pair, _int(STRIDE))),
            )
            position = builder.add(position, builder.add(start, start))
            u = e.fma(broadcast_a, e.subtract(low, center), e.multiply(broadcast_b, dy))
            for slot, value in zip(spill, (position, count, u, e.multiply(broadcast_c, dy)), strict=True):
                builder.store(value, slot)
            left_over = builder.sub(last, top_pair)
            pairs = builder.select(builder.icmp_signed("<", left_over, _int(LANES // 2)), left_over, _int(LANES // 2))

            def emit(lane, carried):
                position, count, u, v = (
                    builder.load(
                        builder.gep(builder.bitcast(slot, kind.as_pointer()), [lane], source_etype=kind), typ=kind
                    )
                    for slot, kind in zip(spill, (INT, INT, FLOAT, FLOAT), strict=True)
                )
                per_row = TILE // COLUMNS
                e.store(data[4], carried[0], builder.add(e.splat(position, per_row), jumps))
                e.store(data[5], carried[0], builder.fadd(e.splat(u, per_row), ramp))
                e.store(data[6], carried[0], e.splat(v, per_row))
                return [builder.add(carried[0], builder.sext(count, LONG))]

            return e.loop(_int(0), builder.shl(pairs, _int(1)), carried, emit, step=2)

        return e.loop(first, last, [arguments[7]], rows, step=LANES // 2)[0]

    return signature, generate


@intrinsic
@no_type_check
def blend_list(typing_context, state, positions, us, vs, masks, start, end, records, g):
    """Blend Gaussian g into vectors start..end; return the union of `masks`, the pixels of each vector that stopped."""
    signature = types.int64(state, positions, us, vs, masks, types.int64, types.int64, records, types.int64)

    def generate(context, builder, signature, arguments):
        e = SimdBuilder(builder)
        data = pointers(context, builder, signature, arguments)
        pixels, splat = data[0], _Splat(e, data[7], arguments[8])

        def body(j, carried):
            position, _, _, y = splat.exponent(data, j)
            before = e.load(pixels, position)
            seen = builder.and_(e.at_most(e.constant(_MIN_LOG_ALPHA), y), e.less(e.constant(0), before))
            alpha = e.minimum(e.exp2(y), e.constant(MAX_ALPHA))
            after = e.fma(e.negate(before), alpha, before)
            stop = builder.and_(seen, e.at_most(after, e.constant(MIN_TRANSMITTANCE)))
            drawn = builder.and_(seen, builder.not_(stop))
            weight = e.select(drawn, e.multiply(before, alpha), e.constant(0))
            e.store(pixels, position, e.select(drawn, after, e.select(stop, e.negate(before), before)))
            for plane, value in enumerate(splat.values, start=1):
                there = builder.add(position, _long(plane * PLANE))
                e.store(pixels, there, e.fma(weight, value, e.load(pixels, there)))
            mask = builder.zext(builder.bitcast(stop, ir.IntType(LANES)), INT)
            e.store(data[4], j, mask)
            return [builder.or_(carried[0], builder.zext(mask, LONG))]

        return e.loop(arguments[5], arguments[6], [_long(0)], body)[0]

    return signature, generate


@intrinsic
@no_type_check
def blend_list_backward(
    typing_context, state, positions, us, vs, start, end, records, g, stops, position, grad_records, slot
):
    """Undo the blending of Gaussian g in vectors start..end and write its record's gradient to grad_records[slot]."""
    signature = types.void(
        state,
        positions,
        us,
        vs,
        types.int64,
        types.int64,
        records,
        types.int64,
        stops,
        types.float32,
        grad_records,
        types.int64,
    )

    def generate(context, builder, signature, arguments):
        e = SimdBuilder(builder)
        data = pointers(context, builder, signature, arguments)
        pixels, splat, own_position = data[0], _Splat(e, data[6], arguments[7]), e.splat(arguments[9])

        def body(j, sums):
            position, u, v, y = splat.exponent(data, j)

            def plane(i):
                return builder.add(position, _long(i * PLANE))

            drawn = builder.and_(
                e.at_most(e.constant(_MIN_LOG_ALPHA), y), e.less(own_position, e.load(data[8], position))
            )  # fmt: skip
            raw = e.select(drawn, e.exp2(y), e.constant(0))
            alpha = e.minimum(raw, e.constant(MAX_ALPHA))
            inverse = e.reciprocal(e.subtract(e.constant(1), alpha))
            before = e.multiply(e.load(pixels, position), inverse)
            behind = e.load(pixels, plane(1))
            gradients = [e.load(pixels, plane(i)) for i in range(2, BACKWARD_PLANES)]
            weight = e.multiply(alpha, before)
            gain = e.multiply(splat.values[3], gradients[3])
            for value, gradient in zip(splat.values[:3], gradients[:3], strict=True):
                gain = e.fma(value, gradient, gain)
            d_alpha = e.fma(before, gain, e.negate(e.multiply(behind, inverse)))
            e.store(pixels, position, before)
            e.store(pixels, plane(1), e.fma(weight, gain, behind))
            s = e.select(e.at_most(raw, e.constant(MAX_ALPHA)), e.multiply(d_alpha, alpha), e.constant(0))
            su, sv = e.multiply(s, u), e.multiply(s, v)
            terms = [(su, u), (su, v), (sv, v), *((weight, gradient) for gradient in gradients)]
            return [
                *(e.add(total, term) for total, term in zip(sums, (s, su, sv), strict=False)),
                *(e.fma(a, b, total) for total, (a, b) in zip(sums[3:], terms, strict=True)),
            ]

        sums = e.loop(arguments[4], arguments[5], [e.constant(0)] * GRAD_FIELDS, body)
        row = builder.mul(arguments[11], _long(RECORD))
        e.store(data[10], row, e.sums(sums))
        return context.get_dummy_value()

    return signature, generate


class _Splat:
    """Record of a Gaussian, broadcast to the lanes of a vector."""

    def __init__(self, e: SimdBuilder, records: Value, g: Value) -> None:
        builder = e.builder
        base = builder.mul(g, _long(RECORD))

        def broadcast(field: int) -> Value:
            return e.splat(e.load(records, builder.add(base, _long(field)), FLOAT))

        a, b, c = broadcast(WHITEN_A), broadcast(WHITEN_B), broadcast(WHITEN_C)
        lane_row = e.constant([float(row) for row in _LANE_ROW])
        lane_column = e.constant([float(column) for column in _LANE_COLUMN])
        self.e = e
        self.lane_u = e.fma(a, lane_column, e.multiply(b, lane_row))
        self.lane_v = e.multiply(c, lane_row)
        self.log_opacity = broadcast(LOG_OPACITY)
        self.values = [broadcast(field) for field in (RED, GREEN, BLUE, DEPTH)]

    def exponent(self, data: list[Value], j: Value) -> tuple[Value, Value, Value, Value]:
        """Return the position of vector j in a plane, (u, v) of its pixels, and log2 of alpha."""
        e, builder = self.e, self.e.builder
        position = builder.sext(e.load(data[1], j, INT), LONG)
        u = e.add(self.lane_u, e.splat(e.load(data[2], j, FLOAT)))
        v = e.add(self.lane_v, e.splat(e.load(data[3], j, FLOAT)))
        return position, u, v, e.fma(e.negate(u), u, e.fma(e.negate(v), v, self.log_opacity))


@intrinsic
@no_type_check
def prefetch(typing_context, array, index):
    """Prefetch the cache line of an element."""

    def generate(context, builder, signature, arguments):
        byte = ir.IntType(8).as_pointer()
        position = builder.gep(pointers(context, builder, signature, arguments)[0], [arguments[1]], source_etype=FLOAT)
        kind = ir.FunctionType(ir.VoidType(), [byte, INT, INT, INT])
        prefetch = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(prefetch, [builder.bitcast(position, byte), _int(0), _int(3), _int(1)])  # read, keep, data
        return context.get_dummy_value()

    return types.void(array, types.int64), generate


def _int(value: int) -> ir.Constant:
    return ir.Constant(INT, value)


def _long(value: int) -> ir.Constant:
    return ir.Constant(LONG, value)


def _float(value: float) -> ir.Constant:
    return ir.Constant(FLOAT, float(np.float32(value)))
