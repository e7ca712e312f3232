"""A vector of 16 float32 lanes for Numba kernels, lowered by LLVM to what the processor has.

LLVM splits ``<16 x float>`` into one AVX-512, two AVX2, or four SSE or NEON registers, so the same
kernel runs anywhere. Vectors support + - * / with vectors and float32 scalars. Arrays passed to
``load`` and ``store`` are contiguous float32 and indexed flat; the alignment is that of a float.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import carray, float32, types
from numba.core import cgutils
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

from gsdmsr_cli.backends.cpu.jit import FLAGS, inline

LANES = 16
_FLOAT = ir.FloatType()
_INT = ir.IntType(32)
VECTOR = ir.VectorType(_FLOAT, LANES)
_VECTOR_INT = ir.VectorType(_INT, LANES)
_VECTOR_BYTE = ir.VectorType(ir.IntType(8), LANES)
FAST = tuple(sorted(FLAGS))


class _Float32x16(types.Type):
    def __init__(self) -> None:
        super().__init__(name="float32x16")


vector = _Float32x16()


@register_model(_Float32x16)
class _Model(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, VECTOR)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(VECTOR, [ir.Constant(_FLOAT, value)] * LANES)


def broadcast(builder: Any, scalar: Any) -> Any:
    """Emit a vector whose lanes are all the scalar."""
    undefined = ir.Constant(VECTOR, ir.Undefined)
    one = builder.insert_element(undefined, scalar, ir.Constant(_INT, 0))
    return builder.shuffle_vector(one, undefined, ir.Constant(_VECTOR_INT, [0] * LANES))


def _address(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    pointer = builder.gep(context.make_array(array_type)(context, builder, array).data, [index])
    return builder.bitcast(pointer, VECTOR.as_pointer())


def _call(builder: Any, name: str, result: Any, arguments: list[Any], **flags: Any) -> Any:
    kind = ir.FunctionType(result, [argument.type for argument in arguments])
    function = cgutils.get_or_insert_function(builder.module, kind, name)
    return builder.call(function, arguments, **flags)


@intrinsic
def splat(_typing: Any, scalar: Any) -> Any:
    """Return the vector whose lanes are all ``scalar``."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return broadcast(builder, context.cast(builder, args[0], sig.args[0], types.float32))

    return vector(scalar), emit


@intrinsic
def iota(_typing: Any, first: Any) -> Any:
    """Return the vector first, first + 1, ... first + 15."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        start = broadcast(builder, context.cast(builder, args[0], sig.args[0], types.float32))
        return builder.fadd(start, ir.Constant(VECTOR, [float(i) for i in range(LANES)]))

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
        return builder.uitofp(loaded, VECTOR)

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
def prefetch(_typing: Any, array: Any, index: Any) -> Any:
    """Ask for the cache line of array[index], which is about to be read or written."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        at = context.cast(builder, args[1], sig.args[1], types.intp)
        address = _address(context, builder, sig.args[0], args[0], at)
        pointer = builder.bitcast(address, ir.IntType(8).as_pointer())
        for_reading, keep, of_data = (ir.Constant(_INT, value) for value in (0, 3, 1))
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, _INT, _INT, _INT])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [pointer, for_reading, keep, of_data])
        return context.get_dummy_value()

    return types.void(array, index), emit


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
            value if kind is vector else broadcast(builder, value)
            for value, kind in zip(args, sig.args, strict=True)
        ]
        return getattr(builder, instruction)(*wide, flags=FAST)

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


@intrinsic
def lanes_le(_typing: Any, x: Any, y: Any) -> Any:
    """Return the integer whose bit j tells whether x <= y in lane j, which no NaN is."""

    def emit(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        test = builder.fcmp_ordered("<=", args[0], args[1])
        return builder.zext(builder.bitcast(test, ir.IntType(LANES)), ir.IntType(64))

    return types.int64(vector, vector), emit


@intrinsic
def count_bits(_typing: Any, bits: Any) -> Any:
    """Return how many bits of an int64 are set."""

    def emit(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        return builder.ctpop(args[0])

    return types.int64(types.int64), emit


@intrinsic
def lowest_bit(_typing: Any, bits: Any) -> Any:
    """Return which bit of an int64 that is not 0 is the lowest that is set."""

    def emit(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), emit


@inline
def empty_aligned(length: int) -> Any:
    """Return an array of ``length`` floats that begins with a cache line of 64 bytes."""
    held = np.empty(length + LANES, np.float32)
    first = (LANES - held.ctypes.data // 4 % LANES) % LANES
    return held[first : first + length]


@inline
def first_lanes(count: int) -> Any:
    """Return the vector that is 1 in the first ``count`` lanes, any number, and 0 elsewhere."""
    return where_ge(splat(float32(count) - float32(0.5)), iota(float32(0)), splat(float32(1)))


@intrinsic
def sqrt(_typing: Any, x: Any) -> Any:
    """Return the square root of every lane."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _call(builder, "llvm.sqrt.v16f32", VECTOR, [args[0]], fastmath=FAST)

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
        whole = _call(builder, "llvm.rint.v16f32", VECTOR, [args[0]])
        fraction = builder.fsub(args[0], whole, flags=FAST)
        power = _constant(coefficients[0])
        for coefficient in coefficients[1:]:
            product = builder.fmul(power, fraction, flags=FAST)
            power = builder.fadd(product, _constant(coefficient), flags=FAST)
        exponent = builder.shl(
            builder.fptosi(whole, _VECTOR_INT), ir.Constant(_VECTOR_INT, [23] * LANES)
        )
        return builder.bitcast(builder.add(builder.bitcast(power, _VECTOR_INT), exponent), VECTOR)

    return vector(vector), emit


@intrinsic
def reduce_sum(_typing: Any, x: Any) -> Any:
    """Return the sum of the lanes."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        zero = ir.Constant(_FLOAT, 0.0)
        name = "llvm.vector.reduce.fadd.v16f32"
        return _call(builder, name, _FLOAT, [zero, args[0]], fastmath=FAST)

    return types.float32(vector), emit


@intrinsic
def reduce_first(_typing: Any, x: Any) -> Any:
    """Return the sum of the first four lanes, in half the time of ``reduce_sum``."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        lanes = ir.Constant(ir.VectorType(_INT, 4), [0, 1, 2, 3])
        first = builder.shuffle_vector(args[0], ir.Constant(VECTOR, ir.Undefined), lanes)
        zero = ir.Constant(_FLOAT, 0.0)
        name = "llvm.vector.reduce.fadd.v4f32"
        return _call(builder, name, _FLOAT, [zero, first], fastmath=FAST)

    return types.float32(vector), emit


@intrinsic
def reduce_max(_typing: Any, x: Any) -> Any:
    """Return the largest lane; lanes must not be NaN."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        flags = (*FAST, "nnan")
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
    return builder.fadd(*parts, flags=FAST)


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
