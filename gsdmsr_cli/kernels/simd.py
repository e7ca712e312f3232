"""A vector of 16 float32 lanes for Numba kernels, lowered by LLVM to what the processor has.

LLVM splits ``<16 x float>`` into one AVX-512, two AVX2, or four SSE or NEON registers, so the same
kernel runs anywhere. Vectors support + - * / with vectors and float32 scalars. Arrays passed to
``load`` and ``store`` are contiguous float32 and indexed flat; the alignment is that of a float.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import carray, float32, types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

from gsdmsr_cli.kernels.jit import FLAGS, inline

LANES = 16
_FLOAT = ir.FloatType()
_INT = ir.IntType(32)
_VECTOR = ir.VectorType(_FLOAT, LANES)
_VECTOR_INT = ir.VectorType(_INT, LANES)
_VECTOR_BYTE = ir.VectorType(ir.IntType(8), LANES)
_FAST = tuple(sorted(FLAGS))


class _Float32x16(types.Type):
    def __init__(self) -> None:
        super().__init__(name="float32x16")


vector = _Float32x16()


@register_model(_Float32x16)
class _Model(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _VECTOR)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_VECTOR, [ir.Constant(_FLOAT, value)] * LANES)


def _broadcast(builder: Any, scalar: Any) -> Any:
    undefined = ir.Constant(_VECTOR, ir.Undefined)
    one = builder.insert_element(undefined, scalar, ir.Constant(_INT, 0))
    return builder.shuffle_vector(one, undefined, ir.Constant(_VECTOR_INT, [0] * LANES))


def _address(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    pointer = builder.gep(context.make_array(array_type)(context, builder, array).data, [index])
    return builder.bitcast(pointer, _VECTOR.as_pointer())


def _call(builder: Any, name: str, result: Any, arguments: list[Any], **flags: Any) -> Any:
    kind = ir.FunctionType(result, [argument.type for argument in arguments])
    function = cgutils.get_or_insert_function(builder.module, kind, name)
    return builder.call(function, arguments, **flags)


@intrinsic
def splat(_typing: Any, scalar: Any) -> Any:
    """Return the vector whose lanes are all ``scalar``."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _broadcast(builder, context.cast(builder, args[0], sig.args[0], types.float32))

    return vector(scalar), emit


@intrinsic
def iota(_typing: Any, first: Any) -> Any:
    """Return the vector first, first + 1, ... first + 15."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        start = _broadcast(builder, context.cast(builder, args[0], sig.args[0], types.float32))
        return builder.fadd(start, ir.Constant(_VECTOR, [float(i) for i in range(LANES)]))

    return vector(first), emit


@intrinsic
def load(_typing: Any, array: Any, index: Any) -> Any:
    """Return array[index : index + 16]."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        at = context.cast(builder, args[1], sig.args[1], types.intp)
        loaded = builder.load(_address(context, builder, sig.args[0], args[0], at))
        loaded.align = 4
        return loaded

    return vector(array, index), emit


@intrinsic
def load_bytes(_typing: Any, array: Any, index: Any) -> Any:
    """Return the floats of array[index : index + 16], a flat array of uint8."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        at = context.cast(builder, args[1], sig.args[1], types.intp)
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        pointer = builder.bitcast(builder.gep(data, [at]), _VECTOR_BYTE.as_pointer())
        loaded = builder.load(pointer)
        loaded.align = 1
        return builder.uitofp(loaded, _VECTOR)

    return vector(array, index), emit


@intrinsic
def store(_typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Set array[index : index + 16] = value."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        at = context.cast(builder, args[1], sig.args[1], types.intp)
        stored = builder.store(args[2], _address(context, builder, sig.args[0], args[0], at))
        stored.align = 4
        return context.get_dummy_value()

    return types.void(array, index, value), emit


@intrinsic
def _pointer(_typing: Any, address: Any) -> Any:
    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.inttoptr(args[0], _FLOAT.as_pointer())

    return types.CPointer(types.float32)(types.intp), emit


@inline
def at_address(address: int, length: int) -> Any:
    """Return the ``length`` floats from ``address`` on as an array; whoever calls keeps them."""
    return carray(_pointer(address), (length,))


def _define_operator(symbol: Callable[..., Any], instruction: str) -> None:
    @infer_global(symbol)
    class _Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            if len(args) == 2 and vector in args:
                return signature(vector, *(a if a is vector else types.float32 for a in args))
            return None

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        wide = [
            value if kind is vector else _broadcast(builder, value)
            for value, kind in zip(args, sig.args, strict=True)
        ]
        return getattr(builder, instruction)(*wide, flags=_FAST)

    for pair in ((vector, vector), (vector, types.float32), (types.float32, vector)):
        lower_builtin(symbol, *pair)(emit)


_define_operator(operator.add, "fadd")
_define_operator(operator.sub, "fsub")
_define_operator(operator.mul, "fmul")
_define_operator(operator.truediv, "fdiv")


def _selecting(comparison: str) -> Any:
    @intrinsic
    def choose(_typing: Any, x: Any, y: Any) -> Any:
        def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            test = builder.fcmp_ordered(comparison, args[0], args[1])
            return builder.select(test, args[0], args[1])

        return vector(vector, vector), emit

    return choose


minimum = _selecting("<")
maximum = _selecting(">")


@intrinsic
def where_ge(_typing: Any, x: Any, y: Any, value: Any) -> Any:
    """Return ``value`` in the lanes where x >= y, and 0 elsewhere."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        test = builder.fcmp_ordered(">=", args[0], args[1])
        return builder.select(test, args[2], _constant(0.0))

    return vector(vector, vector, vector), emit


@intrinsic
def where_positive(_typing: Any, x: Any, value: Any) -> Any:
    """Return ``value`` in the lanes where x > 0, and 0 elsewhere."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        test = builder.fcmp_ordered(">", args[0], _constant(0.0))
        return builder.select(test, args[1], _constant(0.0))

    return vector(vector, vector), emit


@intrinsic
def where_zero(_typing: Any, x: Any, value: Any, other: Any) -> Any:
    """Return ``value`` in the lanes where x is 0, and ``other`` elsewhere."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        test = builder.fcmp_ordered("==", args[0], _constant(0.0))
        return builder.select(test, args[1], args[2])

    return vector(vector, vector, vector), emit


@inline
def first_lanes(count: int) -> Any:
    """Return the vector that is 1 in the first ``count`` lanes, any number, and 0 elsewhere."""
    return where_ge(splat(float32(count) - float32(0.5)), iota(float32(0)), splat(float32(1)))


@intrinsic
def sqrt(_typing: Any, x: Any) -> Any:
    """Return the square root of every lane."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _call(builder, "llvm.sqrt.v16f32", _VECTOR, [args[0]], fastmath=_FAST)

    return vector(vector), emit


@intrinsic
def exp2(_typing: Any, x: Any) -> Any:
    """Return 2^x for -126 <= x <= 127, to a relative 4e-6.

    Rounds to the nearest integer, evaluates a degree-5 polynomial on the fraction in [-1/2, 1/2]
    and adds the integer to the exponent's bits. The rounding is an intrinsic of LLVM because the
    usual trick of adding a large constant does not survive reassociation.
    """
    coefficients = [0.00133992142, 0.00961804886, 0.0555032670, 0.240226462, 0.693147182, 1.0]

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        whole = _call(builder, "llvm.rint.v16f32", _VECTOR, [args[0]])
        fraction = builder.fsub(args[0], whole, flags=_FAST)
        power = _constant(coefficients[0])
        for coefficient in coefficients[1:]:
            product = builder.fmul(power, fraction, flags=_FAST)
            power = builder.fadd(product, _constant(coefficient), flags=_FAST)
        exponent = builder.shl(
            builder.fptosi(whole, _VECTOR_INT), ir.Constant(_VECTOR_INT, [23] * LANES)
        )
        return builder.bitcast(builder.add(builder.bitcast(power, _VECTOR_INT), exponent), _VECTOR)

    return vector(vector), emit


@intrinsic
def reduce_sum(_typing: Any, x: Any) -> Any:
    """Return the sum of the lanes."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        zero = ir.Constant(_FLOAT, 0.0)
        name = "llvm.vector.reduce.fadd.v16f32"
        return _call(builder, name, _FLOAT, [zero, args[0]], fastmath=_FAST)

    return types.float32(vector), emit


@intrinsic
def reduce_max(_typing: Any, x: Any) -> Any:
    """Return the largest lane; lanes must not be NaN."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        flags = (*_FAST, "nnan")
        return _call(builder, "llvm.vector.reduce.fmax.v16f32", _FLOAT, [args[0]], fastmath=flags)

    return types.float32(vector), emit


def _halved(builder: Any, x: Any, y: Any, group: int) -> Any:
    """Add the halves of every ``group`` lanes of x and y; x's results come first, then y's."""
    zero = _constant(0.0)
    starts = range(0, LANES, group)
    low = [start + i for start in starts for i in range(group // 2)]
    low += [lane + LANES for lane in low]
    high = [lane + group // 2 for lane in low]
    x, y = zero if x is None else x, zero if y is None else y
    parts = [builder.shuffle_vector(x, y, ir.Constant(_VECTOR_INT, m)) for m in (low, high)]
    return builder.fadd(*parts, flags=_FAST)


@intrinsic
def reduce_sums(_typing: Any, *vectors: Any) -> Any:
    """Return the vector whose lane j is the sum over lanes of argument j, 0 beyond the last.

    A tree that halves groups of lanes of two vectors at a time needs 33 instructions for nine
    vectors, where reducing them one by one takes 81.
    """

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        values = list(builder.extract_value(args[0], i) for i in range(len(sig.args[0])))
        values += [None] * (LANES - len(values))
        group = LANES
        while group > 1:
            pairs = zip(values[::2], values[1::2], strict=True)
            values = [
                None if x is None and y is None else _halved(builder, x, y, group) for x, y in pairs
            ]
            group //= 2
        return values[0]

    return vector(types.StarArgTuple(vectors)), emit


def make_product_tile(rows: int, columns: int) -> Any:
    """Make the inner loop of a matrix product, with ``rows`` x ``columns`` vectors in registers.

    The result is a kernel function ``tile(a, a0, a_row, a_step, b, b0, b_step, count, c, c0,
    c_row)`` on flat arrays that computes, for r < rows and j < 16 * columns::

        c[c0 + r * c_row + j] += sum over k < count of
            a[a0 + r * a_row + k * a_step] * b[b0 + k * b_step + j]

    Written as LLVM so that the accumulators are registers for certain and the code stays short;
    6 x 4 fills the register file of AVX-512 with 24 accumulators, 4 of b and one of a.
    """

    @intrinsic
    def tile(
        _typing: Any,
        a: Any,
        a0: Any,
        a_row: Any,
        a_step: Any,
        b: Any,
        b0: Any,
        b_step: Any,
        count: Any,
        c: Any,
        c0: Any,
        c_row: Any,
    ) -> Any:
        def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            def integer(position: int) -> Any:
                return context.cast(builder, args[position], sig.args[position], types.intp)

            def data(position: int) -> Any:
                kind = sig.args[position]
                return context.make_array(kind)(context, builder, args[position]).data

            a_data, b_data, c_data = data(0), data(4), data(8)
            c_at = [
                builder.gep(c_data, [builder.add(integer(9), builder.mul(integer(10), _intp(r)))])
                for r in range(rows)
            ]
            a_at = [
                builder.gep(a_data, [builder.add(integer(1), builder.mul(integer(2), _intp(r)))])
                for r in range(rows)
            ]
            b_at = builder.gep(b_data, [integer(5)])

            def vector_at(pointer: Any, column: int) -> Any:
                shifted = builder.gep(pointer, [_intp(column * LANES)])
                return builder.bitcast(shifted, _VECTOR.as_pointer())

            sums = [[cgutils.alloca_once(builder, _VECTOR) for _ in range(columns)] for _ in c_at]
            for r in range(rows):
                for j in range(columns):
                    start = builder.load(vector_at(c_at[r], j))
                    start.align = 4
                    builder.store(start, sums[r][j])
            with cgutils.for_range(builder, integer(7)) as loop:
                b_now = builder.gep(b_at, [builder.mul(loop.index, integer(6))])
                right = []
                for j in range(columns):
                    loaded = builder.load(vector_at(b_now, j))
                    loaded.align = 4
                    right.append(loaded)
                a_shift = builder.mul(loop.index, integer(3))
                for r in range(rows):
                    left = _broadcast(builder, builder.load(builder.gep(a_at[r], [a_shift])))
                    for j in range(columns):
                        product = builder.fmul(left, right[j], flags=_FAST)
                        total = builder.fadd(builder.load(sums[r][j]), product, flags=_FAST)
                        builder.store(total, sums[r][j])
            for r in range(rows):
                for j in range(columns):
                    done = builder.store(builder.load(sums[r][j]), vector_at(c_at[r], j))
                    done.align = 4
            return context.get_dummy_value()

        return types.void(a, a0, a_row, a_step, b, b0, b_step, count, c, c0, c_row), emit

    return tile


def _intp(value: int) -> ir.Constant:
    return ir.Constant(ir.IntType(types.intp.bitwidth), value)
