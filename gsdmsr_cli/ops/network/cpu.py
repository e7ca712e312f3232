"""Small networks: all layers of a few rows at a time, so that what passes between stays in cache.

Weights are (in, out), one array per layer, every width but the last a multiple of 16; the kernels
pack them into one array in which the last is as well. ReLU follows every layer but the last. The
work is cut into a fixed number of blocks of rows, so that sums over rows do not depend on the
number of threads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import float32, prange

from gsdmsr_cli.backends.cpu import simd
from gsdmsr_cli.backends.cpu.jit import inline, parallel, serial
from gsdmsr_cli.backends.cpu.product import make_product_tile

_BLOCKS = 32

_CHUNK = 64
_LANES = simd.LANES


def _make_strip(height: int, vectors: int) -> Any:
    """Make the product of all rows, ``height`` at a time, with so many vectors of columns."""
    many, one = make_product_tile(height, vectors), make_product_tile(1, vectors)

    @inline
    def strip(a, a0, a_row, a_step, rows, b, b0, b_step, count, c, c0, c_row):
        whole = rows // height * height
        for r in range(0, whole, height):
            many(a, a0 + r * a_row, a_row, a_step, b, b0, b_step, count, c, c0 + r * c_row, c_row)
        for r in range(whole, rows):
            one(a, a0 + r * a_row, a_row, a_step, b, b0, b_step, count, c, c0 + r * c_row, c_row)

    return strip


_strip_of_4, _strip_of_2, _strip_of_1 = _make_strip(4, 4), _make_strip(8, 2), _make_strip(8, 1)


@serial
def _add_product(a, a0, a_row, a_step, rows, b, b0, b_step, count, c, c0, c_row, columns):
    """c[r, j] += sum_k a[r, k] b[k, j] on flat arrays with given origins and strides.

    The columns are done four vectors at a time, then two, then one, each with as many rows as keep
    about 16 sums in registers.
    """
    j = 0
    while columns - j >= 4 * _LANES:
        _strip_of_4(a, a0, a_row, a_step, rows, b, b0 + j, b_step, count, c, c0 + j, c_row)
        j += 4 * _LANES
    while columns - j >= 2 * _LANES:
        _strip_of_2(a, a0, a_row, a_step, rows, b, b0 + j, b_step, count, c, c0 + j, c_row)
        j += 2 * _LANES
    if columns > j:
        _strip_of_1(a, a0, a_row, a_step, rows, b, b0 + j, b_step, count, c, c0 + j, c_row)


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


@inline
def _packed(weights, biases, turned):
    """Return widths, weights and biases, each flat; the weights as (out, in) if ``turned``."""
    layers = len(weights)
    widths = np.empty(layers + 1, np.int64)
    widths[0] = weights[0].shape[0]
    size, columns = 0, 0
    for layer in range(layers):
        widths[layer + 1] = (weights[layer].shape[1] + _LANES - 1) // _LANES * _LANES
        size += widths[layer] * widths[layer + 1]
        columns += widths[layer + 1]
    flat, offsets = np.zeros(size, np.float32), np.zeros(columns, np.float32)
    at, column = 0, 0
    for layer in range(layers):
        k, o, weight = widths[layer], widths[layer + 1], weights[layer]
        for j in range(weight.shape[1]):
            offsets[column + j] = biases[layer][j]
            for i in range(k):
                flat[at + (j * k + i if turned else i * o + j)] = weight[i, j]
        at, column = at + k * o, column + o
    return widths, flat, offsets


@parallel
def forward(x, weights, biases, outputs):
    """Write the outputs of all layers.

    Args:
        x: (N, inputs or more), of which the first columns are read.
        weights, biases: one array per layer.
        outputs: out, of all layers, flat: (N, outputs of the first), then of the second and so on,
            the last rounded up to a multiple of 16.
    """
    n, layers, x_flat, x_row = x.shape[0], len(weights), x.reshape(-1), x.shape[1]
    widths, w_flat, b_flat = _packed(weights, biases, False)
    for block in prange(_BLOCKS):
        zero = simd.splat(float32(0))
        last = n * (block + 1) // _BLOCKS
        for start in range(n * block // _BLOCKS, last, _CHUNK):
            rows = min(_CHUNK, last - start)
            w_at, b_at, x_at, y_at = 0, 0, 0, 0
            for layer in range(layers):
                k, o = widths[layer], widths[layer + 1]
                here = y_at + start * o
                for at in range(here, here + rows * o, o):
                    for j in range(0, o, _LANES):
                        simd.store(outputs, at + j, simd.load(b_flat, b_at + j))
                source = x_flat if layer == 0 else outputs
                pitch = x_row if layer == 0 else k
                _add_product(
                    source, x_at + start * pitch, pitch, 1, rows, w_flat, w_at, o, k,
                    outputs, here, o, o,
                )  # fmt: skip
                if layer < layers - 1:
                    for at in range(here, here + rows * o, _LANES):
                        simd.store(outputs, at, simd.maximum(simd.load(outputs, at), zero))
                x_at = y_at
                w_at, b_at, y_at = w_at + k * o, b_at + o, y_at + n * o


@parallel
def backward(x, weights, biases, outputs, d_y, d_weights, d_biases, d_x, add):
    """Write the gradients of weights, biases and inputs.

    Args:
        x, weights, biases, outputs: see ``forward``.
        d_y: (N, outputs) gradient of the last layer's output.
        d_weights, d_biases: out, one array per layer.
        d_x: like x, out, 0 in the columns that are not read; or (0, 0) if not wanted.
        add: add to ``d_x`` what it holds already.
    """
    n, layers, x_flat, x_row = x.shape[0], len(weights), x.reshape(-1), x.shape[1]
    widths, turned, offsets = _packed(weights, biases, True)
    d_x_flat, wanted, widest = d_x.reshape(-1), d_x.shape[0] > 0, widths.max()
    size, columns, total = turned.shape[0], offsets.shape[0], outputs.shape[0]
    w_sums = np.zeros((_BLOCKS, size), np.float32)
    b_sums = np.zeros((_BLOCKS, columns), np.float32)
    w_flat, b_flat = w_sums.reshape(-1), b_sums.reshape(-1)
    for block in prange(_BLOCKS):
        after = np.empty(_CHUNK * widest, np.float32)
        before = np.empty(_CHUNK * widest, np.float32)
        last = n * (block + 1) // _BLOCKS
        for start in range(n * block // _BLOCKS, last, _CHUNK):
            rows = min(_CHUNK, last - start)
            w_at, b_at, y_at = size, columns, total
            o = widths[layers]
            after[: rows * o] = float32(0)
            for r in range(rows):
                for j in range(d_y.shape[1]):
                    after[r * o + j] = d_y[start + r, j]
            for layer in range(layers - 1, -1, -1):
                k, o = widths[layer], widths[layer + 1]
                w_at, b_at, y_at = w_at - k * o, b_at - o, y_at - n * o
                x_at = 0 if layer == 0 else y_at - n * k
                source = x_flat if layer == 0 else outputs
                pitch = x_row if layer == 0 else k
                _add_rows(after, rows, o, b_flat, block * columns + b_at)
                _add_product(
                    source, x_at + start * pitch, 1, pitch, k, after, 0, o, rows,
                    w_flat, block * size + w_at, o, o,
                )  # fmt: skip
                if layer > 0:
                    before[: rows * k] = float32(0)
                    _add_product(after, 0, o, 1, rows, turned, w_at, k, o, before, 0, k, k)
                    _mask(before, outputs, x_at + start * k, rows * k)
                    after, before = before, after
                elif wanted:
                    if not add:
                        d_x_flat[start * x_row : (start + rows) * x_row] = float32(0)
                    _add_product(
                        after, 0, o, 1, rows, turned, w_at, k, o, d_x_flat, start * x_row, x_row, k
                    )
    for block in range(1, _BLOCKS):
        for o in range(0, size, _LANES):
            simd.store(w_flat, o, simd.load(w_flat, o) + simd.load(w_flat, block * size + o))
        for o in range(0, columns, _LANES):
            simd.store(b_flat, o, simd.load(b_flat, o) + simd.load(b_flat, block * columns + o))
    w_at, b_at = 0, 0
    for layer in range(layers):
        k, o = widths[layer], widths[layer + 1]
        for j in range(d_biases[layer].shape[0]):
            d_biases[layer][j] = b_flat[b_at + j]
        for i in range(k):
            for j in range(d_weights[layer].shape[1]):
                d_weights[layer][i, j] = w_flat[w_at + i * o + j]
        w_at, b_at = w_at + k * o, b_at + o
