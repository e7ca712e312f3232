"""Linear layers of small networks: register-blocked products with bias, ReLU and their backward.

Weights are (in, out) with ``out`` a multiple of 16. The work is cut into a fixed number of blocks
of rows, so that sums over rows do not depend on the number of threads.
"""

from __future__ import annotations

from numba import float32, prange

from gsdmsr_cli.kernels import simd
from gsdmsr_cli.kernels.jit import inline, parallel

BLOCKS = 32
"""Blocks of rows; the weights' gradient comes in as many parts."""

_LANES = simd.LANES
_ROWS = 4
_WIDE = 4 * _LANES
_tile_4x4 = simd.make_product_tile(_ROWS, 4)
_tile_4x1 = simd.make_product_tile(_ROWS, 1)
_tile_1x4 = simd.make_product_tile(1, 4)
_tile_1x1 = simd.make_product_tile(1, 1)


@inline
def _add_product(a, a0, a_row, a_step, rows, b, b0, b_step, count, c, c0, c_row, columns):
    """c[r, j] += sum_k a[r, k] b[k, j] on flat arrays with given origins and strides."""
    whole, wide = rows // _ROWS * _ROWS, columns // _WIDE * _WIDE
    for r in range(0, whole, _ROWS):
        a_at, c_at = a0 + r * a_row, c0 + r * c_row
        for j in range(0, wide, _WIDE):
            _tile_4x4(a, a_at, a_row, a_step, b, b0 + j, b_step, count, c, c_at + j, c_row)
        for j in range(wide, columns, _LANES):
            _tile_4x1(a, a_at, a_row, a_step, b, b0 + j, b_step, count, c, c_at + j, c_row)
    for r in range(whole, rows):
        a_at, c_at = a0 + r * a_row, c0 + r * c_row
        for j in range(0, wide, _WIDE):
            _tile_1x4(a, a_at, a_row, a_step, b, b0 + j, b_step, count, c, c_at + j, c_row)
        for j in range(wide, columns, _LANES):
            _tile_1x1(a, a_at, a_row, a_step, b, b0 + j, b_step, count, c, c_at + j, c_row)


@parallel
def linear(x, weight, bias, relu, y):
    """Write y = x weight + bias, or its positive part; x (N, K), weight (K, O), y (N, O)."""
    n, inputs, outputs = x.shape[0], x.shape[1], weight.shape[1]
    x_flat, w_flat, y_flat = x.reshape(-1), weight.reshape(-1), y.reshape(-1)
    for block in prange(BLOCKS):
        first, last = n * block // BLOCKS, n * (block + 1) // BLOCKS
        zero = simd.splat(float32(0))
        for start in range(first, last, _ROWS):
            rows = min(_ROWS, last - start)
            for o in range(start * outputs, (start + rows) * outputs, outputs):
                for j in range(0, outputs, _LANES):
                    simd.store(y_flat, o + j, simd.load(bias, j))
            _add_product(
                x_flat, start * inputs, inputs, 1, rows, w_flat, 0, outputs, inputs,
                y_flat, start * outputs, outputs, outputs,
            )  # fmt: skip
            if relu:
                for o in range(start * outputs, (start + rows) * outputs, _LANES):
                    simd.store(y_flat, o, simd.maximum(simd.load(y_flat, o), zero))


@parallel
def linear_backward_input(d_y, weight_t, hidden, masked, d_x):
    """Write d_x = d_y weight^T, zero where the ReLU output ``hidden`` (N, K) is 0 if ``masked``.

    ``weight_t`` is (O, K) with K a multiple of 16.
    """
    n, outputs, inputs = d_y.shape[0], weight_t.shape[0], weight_t.shape[1]
    y_flat, w_flat, x_flat = d_y.reshape(-1), weight_t.reshape(-1), d_x.reshape(-1)
    h_flat = hidden.reshape(-1)
    for block in prange(BLOCKS):
        first, last = n * block // BLOCKS, n * (block + 1) // BLOCKS
        zero = simd.splat(float32(0))
        for start in range(first, last, _ROWS):
            rows = min(_ROWS, last - start)
            for o in range(start * inputs, (start + rows) * inputs, _LANES):
                simd.store(x_flat, o, zero)
            _add_product(
                y_flat, start * outputs, outputs, 1, rows, w_flat, 0, inputs, outputs,
                x_flat, start * inputs, inputs, inputs,
            )  # fmt: skip
            if masked:
                for o in range(start * inputs, (start + rows) * inputs, _LANES):
                    kept = simd.where_positive(simd.load(h_flat, o), simd.load(x_flat, o))
                    simd.store(x_flat, o, kept)


@parallel
def linear_backward_weight(x, d_y, d_weight, d_bias):
    """Write the parts of the gradients of weight (BLOCKS, K, O) and bias (BLOCKS, O)."""
    n, inputs, outputs = x.shape[0], x.shape[1], d_y.shape[1]
    x_flat, y_flat = x.reshape(-1), d_y.reshape(-1)
    w_flat, b_flat = d_weight.reshape(-1), d_bias.reshape(-1)
    for block in prange(BLOCKS):
        first, last = n * block // BLOCKS, n * (block + 1) // BLOCKS
        d_weight[block] = float32(0)
        d_bias[block] = float32(0)
        for start in range(first, last, 256):
            count = min(256, last - start)
            for j in range(0, outputs, _LANES):
                total = simd.load(b_flat, block * outputs + j)
                for o in range(start * outputs + j, (start + count) * outputs + j, outputs):
                    total = total + simd.load(y_flat, o)
                simd.store(b_flat, block * outputs + j, total)
            _add_product(
                x_flat, start * inputs, 1, inputs, inputs, y_flat, start * outputs, outputs, count,
                w_flat, block * inputs * outputs, outputs, outputs,
            )  # fmt: skip
