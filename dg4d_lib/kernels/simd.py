"""SIMD code generation inside Numba: LLVM vectors of 16 floats.

Numba does not vectorize the blending loops by itself (branches, reductions, possible aliasing), so they are emitted as
LLVM vectors; LLVM lowers each to one AVX-512 register, two AVX2 registers, or four SSE or NEON registers.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils

Value: TypeAlias = Any  # llvmlite value; its type stubs lack the attributes

LANES = 16  # floats per vector
FLOAT, INT, LONG = ir.FloatType(), ir.IntType(32), ir.IntType(64)
FLOATS, INTS = ir.VectorType(FLOAT, LANES), ir.VectorType(INT, LANES)
# Not arcp and afn: they lose too many digits on needle-shaped Gaussians. Not nnan and ninf: comparisons would no longer
# reject values that are not finite.
FAST = ("nsz", "contract", "reassoc")
KERNEL = {"fastmath": set(FAST), "nogil": True, "cache": True, "error_model": "numpy"}  # options of njit
INLINE = {**KERNEL, "inline": "always"}
_EXP2 = (1.3333558e-3, 9.6181291e-3, 5.5504109e-2, 2.4022651e-1, 6.9314718e-1, 1.0)  # polynomial of 2^f, |f| <= 1/2


class SimdBuilder:
    """Emitter of instructions on vectors of `LANES` floats at the current position of an LLVM builder.

    `fma` emits llvm.fmuladd: fused where the CPU supports it, else two instructions (llvm.fma would call libm).
    """

    def __init__(self, builder: ir.IRBuilder) -> None:
        self.builder = builder

    def constant(self, values: float | Sequence[float]) -> Value:
        """Return a constant vector: the same float in all lanes, or one per lane."""
        lanes = np.broadcast_to(np.asarray(values, np.float32), LANES)
        return ir.Constant(FLOATS, [float(value) for value in lanes])

    def integers(self, values: int | Sequence[int]) -> Value:
        """Return a constant vector: the same int32 in all lanes, or one per lane."""
        return ir.Constant(INTS, [int(value) for value in np.broadcast_to(values, LANES)])

    def splat(self, scalar: Value, lanes: int = LANES) -> Value:
        """Broadcast a scalar to all lanes."""
        undefined = ir.Constant(ir.VectorType(scalar.type, lanes), ir.Undefined)
        first = self.builder.insert_element(undefined, scalar, ir.Constant(INT, 0))
        return self.builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(INT, lanes), [0] * lanes))

    def add(self, a: Value, b: Value) -> Value:
        """Emit a + b."""
        return self.builder.fadd(a, b, flags=FAST)

    def subtract(self, a: Value, b: Value) -> Value:
        """Emit a - b."""
        return self.builder.fsub(a, b, flags=FAST)

    def multiply(self, a: Value, b: Value) -> Value:
        """Emit a * b."""
        return self.builder.fmul(a, b, flags=FAST)

    def reciprocal(self, a: Value) -> Value:
        """Emit 1 / a."""
        return self.builder.fdiv(self.constant(1), a, flags=FAST)

    def negate(self, a: Value) -> Value:
        """Emit -a."""
        return self.builder.fneg(a)

    def fma(self, a: Value, b: Value, c: Value) -> Value:
        """Emit a * b + c."""
        return self.call("fmuladd", a, b, c)

    def less(self, a: Value, b: Value) -> Value:
        """Emit the mask a < b."""
        return self.builder.fcmp_ordered("<", a, b)

    def at_most(self, a: Value, b: Value) -> Value:
        """Emit the mask a <= b."""
        return self.builder.fcmp_ordered("<=", a, b)

    def select(self, mask: Value, a: Value, b: Value) -> Value:
        """Emit a where the mask is set, else b."""
        return self.builder.select(mask, a, b)

    def minimum(self, a: Value, b: Value) -> Value:
        """Emit the minimum of two vectors or scalars."""
        return self.select(self.less(a, b), a, b)

    def maximum(self, a: Value, b: Value) -> Value:
        """Emit the maximum of two vectors or scalars."""
        return self.select(self.less(b, a), a, b)

    def call(self, name: str, *arguments: Value) -> Value:
        """Call an LLVM intrinsic on vectors: sqrt, ceil, floor, rint, fmuladd."""
        signature = ir.FunctionType(FLOATS, [FLOATS] * len(arguments))
        function = cgutils.get_or_insert_function(self.builder.module, signature, f"llvm.{name}.v{LANES}f32")
        return self.builder.call(function, arguments)

    def exp2(self, a: Value) -> Value:
        """Emit 2^a for a <= 127, clamped to 2^-126 below; relative error 2e-7."""
        a = self.maximum(a, self.constant(-126))
        whole = self.call("rint", a)
        fraction = self.subtract(a, whole)
        power = self.constant(_EXP2[0])
        for coefficient in _EXP2[1:]:
            power = self.fma(power, fraction, self.constant(coefficient))
        exponent = self.builder.shl(self.builder.fptosi(whole, INTS), self.integers(23))
        return self.builder.bitcast(self.builder.add(self.builder.bitcast(power, INTS), exponent), FLOATS)

    def sum(self, a: Value) -> Value:
        """Reduce a vector to the scalar sum of its lanes."""
        signature = ir.FunctionType(FLOAT, [FLOAT, FLOATS])
        name = f"llvm.vector.reduce.fadd.v{LANES}f32"
        function = cgutils.get_or_insert_function(self.builder.module, signature, name)
        return self.builder.call(function, [ir.Constant(FLOAT, 0.0), a], fastmath=FAST)

    def sums(self, terms: Sequence[Value]) -> Value:
        """Reduce up to `LANES` vectors to one vector with the sum of each in a lane; unused lanes are 0.

        Neighboring vectors are added crosswise, so each round halves the number of vectors and of terms left in each:
        two shuffles per pair instead of log2(LANES) per vector.
        """
        lanes, remaining, step = range(LANES), list(terms), 1
        while step < LANES:
            remaining += [self.constant(0)] * (len(remaining) % 2)
            remaining = [
                self.add(
                    self._pick(a, b, [lane + LANES * bool(lane & step) for lane in lanes]),
                    self._pick(a, b, [(lane ^ step) + LANES * bool(lane & step) for lane in lanes]),
                )
                for a, b in zip(remaining[::2], remaining[1::2], strict=True)
            ]
            step *= 2
        return remaining[0]

    def shift(self, a: Value, lanes: int) -> Value:
        """Move lane i + `lanes` to lane i; lanes that come from outside are 0."""
        return self._pick(a, self.constant(0), [i + lanes if 0 <= i + lanes < LANES else LANES for i in range(LANES)])

    def _pick(self, a: Value, b: Value, lanes: Sequence[int]) -> Value:
        """Shuffle the lanes of two vectors; lanes of the second are numbered from `LANES` on."""
        return self.builder.shuffle_vector(a, b, ir.Constant(INTS, list(lanes)))

    def load(self, pointer: Value, index: Value, kind: ir.Type = FLOATS) -> Value:
        """Load a vector or a scalar at an element of a float or int32 array; no vector alignment needed."""
        return self.builder.load(self._address(pointer, index, kind), align=4, typ=kind)

    def store(self, pointer: Value, index: Value, value: Value) -> None:
        """Store a vector or a scalar at an element of a float or int32 array; no vector alignment needed."""
        self.builder.store(value, self._address(pointer, index, value.type), align=4)

    def _address(self, pointer: Value, index: Value, kind: ir.Type) -> Value:
        return self.builder.bitcast(self.builder.gep(pointer, [index], source_etype=FLOAT), kind.as_pointer())

    def loop(
        self,
        start: Value,
        stop: Value,
        carried: Sequence[Value],
        body: Callable[[Value, list[Value]], Sequence[Value]],
        step: int = 1,
    ) -> list[Value]:
        """Emit a counted loop; `body` maps the index and the carried values to their next values.

        Returns:
            The carried values after the last iteration.
        """
        builder = self.builder
        before, inside, after = (
            builder.basic_block,
            builder.append_basic_block("loop"),
            builder.append_basic_block("done"),
        )
        builder.cbranch(builder.icmp_signed("<", start, stop), inside, after)
        builder.position_at_end(inside)
        current = [builder.phi(value.type) for value in (start, *carried)]
        for phi, value in zip(current, (start, *carried), strict=True):
            phi.add_incoming(value, before)
        results = body(current[0], current[1:])
        index = builder.add(current[0], ir.Constant(start.type, step))
        end = builder.basic_block
        for phi, value in zip(current, (index, *results), strict=True):
            phi.add_incoming(value, end)
        builder.cbranch(builder.icmp_signed("<", index, stop), inside, after)
        builder.position_at_end(after)
        final = [builder.phi(value.type) for value in carried]
        for phi, first, last in zip(final, carried, results, strict=True):
            phi.add_incoming(first, before)
            phi.add_incoming(last, end)
        return final


def pointers(context: Any, builder: Any, signature: Any, arguments: Sequence[Value]) -> list[Value]:
    """Return the data pointers of an intrinsic's array arguments; None for scalars."""
    return [
        context.make_array(kind)(context, builder, value).data if isinstance(kind, types.Array) else None
        for kind, value in zip(signature.args, arguments, strict=True)
    ]
