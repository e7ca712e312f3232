"""Small networks: all layers of a few rows at a time, so that what passes between stays in cache.

Weights are (in, out), one layer after the other in one flat array, every width a multiple of 16.
ReLU follows every layer but the last. The work is cut into a fixed number of blocks of rows, so
that sums over rows do not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np
from numba import float32, prange

from gsdmsr_cli.kernels import simd
from gsdmsr_cli.kernels.jit import inline, parallel, serial

BLOCKS = 32
"""Blocks of rows; the weights' gradient comes in as many parts."""

_CHUNK = 64
_LANES = simd.LANES
_ROWS = 4
_WIDE = 4 * _LANES
_tile_4x4 = simd.make_product_tile(_ROWS, 4)
_tile_4x1 = simd.make_product_tile(_ROWS, 1)
_tile_1x4 = simd.make_product_tile(1, 4)
_tile_1x1 = simd.make_product_tile(1, 1)


@serial
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


@inline
def _add_rows(values, rows, width, sums, at):
    """Add the sum of all rows to ``sums``, from ``at`` on."""
    for j in range(0, width, _LANES):
        total = simd.load(sums, at + j)
        for o in range(j, rows * width + j, width):
            total = total + simd.load(values, o)
        simd.store(sums, at + j, total)


@inline
def _mask(values, outputs, at, count):
    """Set to zero what a ReLU has held back: where its output, from ``at`` on, is not positive."""
    for o in range(0, count, _LANES):
        kept = simd.where_positive(simd.load(outputs, at + o), simd.load(values, o))
        simd.store(values, o, kept)


@parallel
def forward(x, widths, weights, biases, outputs):
    """Write the outputs of all layers.

    Args:
        x: (N, widths[0]) inputs.
        widths: (L + 1,) of the inputs and of every layer's output.
        weights, biases: of all layers, flat.
        outputs: out, of all layers, flat: (N, widths[1]), then (N, widths[2]) and so on.
    """
    n, layers, x_flat = x.shape[0], widths.shape[0] - 1, x.reshape(-1)
    for block in prange(BLOCKS):
        zero = simd.splat(float32(0))
        last = n * (block + 1) // BLOCKS
        for start in range(n * block // BLOCKS, last, _CHUNK):
            rows = min(_CHUNK, last - start)
            w_at, b_at, x_at, y_at = 0, 0, 0, 0
            for layer in range(layers):
                k, o = widths[layer], widths[layer + 1]
                here = y_at + start * o
                for at in range(here, here + rows * o, o):
                    for j in range(0, o, _LANES):
                        simd.store(outputs, at + j, simd.load(biases, b_at + j))
                source = x_flat if layer == 0 else outputs
                _add_product(
                    source, x_at + start * k, k, 1, rows, weights, w_at, o, k, outputs, here, o, o
                )
                if layer < layers - 1:
                    for at in range(here, here + rows * o, _LANES):
                        simd.store(outputs, at, simd.maximum(simd.load(outputs, at), zero))
                x_at = y_at
                w_at, b_at, y_at = w_at + k * o, b_at + o, y_at + n * o


@parallel
def backward(x, widths, turned, outputs, d_y, d_weights, d_biases, d_x):
    """Write the gradients of weights, biases and inputs.

    Args:
        x, widths, outputs: see ``forward``.
        turned: the weights, flat, every layer's as (out, in).
        d_y: (N, widths[L]) gradient of the last layer's output.
        d_weights, d_biases: (BLOCKS, ...) out, flat like the weights, in parts to be summed.
        d_x: (N, widths[0]) out, or (0, 0) if not wanted.
    """
    n, layers, x_flat = x.shape[0], widths.shape[0] - 1, x.reshape(-1)
    y_flat, w_flat, b_flat = d_y.reshape(-1), d_weights.reshape(-1), d_biases.reshape(-1)
    d_x_flat, wanted, widest = d_x.reshape(-1), d_x.shape[0] > 0, widths.max()
    total = 0
    for layer in range(layers):
        total += n * widths[layer + 1]
    for block in prange(BLOCKS):
        d_weights[block] = float32(0)
        d_biases[block] = float32(0)
        after = np.empty(_CHUNK * widest, np.float32)
        before = np.empty(_CHUNK * widest, np.float32)
        last = n * (block + 1) // BLOCKS
        for start in range(n * block // BLOCKS, last, _CHUNK):
            rows = min(_CHUNK, last - start)
            w_at, b_at, y_at = d_weights.shape[1], d_biases.shape[1], total
            o = widths[layers]
            for at in range(0, rows * o, _LANES):
                simd.store(after, at, simd.load(y_flat, start * o + at))
            for layer in range(layers - 1, -1, -1):
                k, o = widths[layer], widths[layer + 1]
                w_at, b_at, y_at = w_at - k * o, b_at - o, y_at - n * o
                x_at = 0 if layer == 0 else y_at - n * k
                source = x_flat if layer == 0 else outputs
                _add_rows(after, rows, o, b_flat, block * d_biases.shape[1] + b_at)
                _add_product(
                    source, x_at + start * k, 1, k, k, after, 0, o, rows,
                    w_flat, block * d_weights.shape[1] + w_at, o, o,
                )  # fmt: skip
                if layer > 0:
                    before[: rows * k] = float32(0)
                    _add_product(after, 0, o, 1, rows, turned, w_at, k, o, before, 0, k, k)
                    _mask(before, outputs, x_at + start * k, rows * k)
                    after, before = before, after
                elif wanted:
                    d_x_flat[start * k : (start + rows) * k] = float32(0)
                    _add_product(
                        after, 0, o, 1, rows, turned, w_at, k, o, d_x_flat, start * k, k, k
                    )
