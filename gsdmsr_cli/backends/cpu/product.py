"""The inner loop of matrix products, with its sums in registers."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from gsdmsr_cli.backends.cpu.simd import FAST, LANES, VECTOR, broadcast


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
                return builder.bitcast(shifted, VECTOR.as_pointer())

            sums = [[cgutils.alloca_once(builder, VECTOR) for _ in range(columns)] for _ in c_at]
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
                    left = broadcast(builder, builder.load(builder.gep(a_at[r], [a_shift])))
                    for j in range(columns):
                        product = builder.fmul(left, right[j], flags=FAST)
                        total = builder.fadd(builder.load(sums[r][j]), product, flags=FAST)
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
