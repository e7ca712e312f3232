"""The vector type: every operation on 16 lanes against numpy."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray

from gsdmsr_cli.backends.cpu import simd
from gsdmsr_cli.backends.cpu.jit import serial
from gsdmsr_cli.backends.cpu.product import make_product_tile
from gsdmsr_cli.backends.cpu.simd import LANES

Floats = NDArray[np.float32]

finite = st.floats(-1e6, 1e6, width=32)
vectors = arrays.arrays(np.float32, LANES, elements=finite)
any_vectors = arrays.arrays(np.float32, LANES, elements=st.floats(width=32, allow_subnormal=False))


@serial
def apply_exp2(x, out):
    for o in range(0, x.shape[0], LANES):
        simd.store(out, o, simd.exp2(simd.load(x, o)))


@serial
def apply_sqrt(x, out):
    simd.store(out, 0, simd.sqrt(simd.load(x, 0)))


@serial
def apply_arithmetic(x, y, s, out):
    a, b = simd.load(x, 0), simd.load(y, 0)
    simd.store(out, 0, a + b)
    simd.store(out, 16, a - b)
    simd.store(out, 32, a * b)
    simd.store(out, 48, a / b)
    simd.store(out, 64, a + s)
    simd.store(out, 80, s - a)
    simd.store(out, 96, a * s)
    simd.store(out, 112, s / b)


@serial
def apply_choices(x, y, value, out):
    a, b, v = simd.load(x, 0), simd.load(y, 0), simd.load(value, 0)
    simd.store(out, 0, simd.minimum(a, b))
    simd.store(out, 16, simd.maximum(a, b))
    simd.store(out, 32, simd.where_ge(a, b, v))
    simd.store(out, 48, simd.where_positive(a, v))


@serial
def bytes_as_floats(x, at, out):
    simd.store(out, 0, simd.load_bytes(x, at))


@serial
def apply_reductions(x):
    a = simd.load(x, 0)
    return simd.reduce_sum(a), simd.reduce_max(a)


@serial
def apply_reduce_sums_1(x, out):
    simd.store(out, 0, simd.reduce_sums(simd.load(x, 0)))


@serial
def apply_reduce_sums_9(x, out):
    sums = simd.reduce_sums(
        simd.load(x, 0), simd.load(x, 16), simd.load(x, 32), simd.load(x, 48), simd.load(x, 64),
        simd.load(x, 80), simd.load(x, 96), simd.load(x, 112), simd.load(x, 128),
    )  # fmt: skip
    simd.store(out, 0, sums)


@serial
def apply_fill(first, scalar, out):
    simd.store(out, 0, simd.iota(first))
    simd.store(out, LANES, simd.splat(scalar))


@serial
def copy_lanes(x, at, out, to):
    simd.store(out, to, simd.load(x, at))


def exp2_of(x: NDArray[Any]) -> Floats:
    x = np.ascontiguousarray(x, np.float32)
    out = np.empty_like(x)
    apply_exp2(x, out)
    return out


def test_exp2_is_accurate_over_its_range() -> None:
    rng = np.random.default_rng(0)
    halves = np.arange(-125, 127) + 0.5
    x = np.concatenate(
        [rng.uniform(-126, 127, 1 << 16), rng.uniform(-8, 1, 1 << 16), halves, halves[:4]]
    )
    x = np.concatenate([x.astype(np.float32), np.nextafter(x.astype(np.float32), np.float32(0))])
    exact = np.exp2(x.astype(np.float64))
    assert np.abs(exp2_of(x) / exact - 1).max() < 4e-6


def test_exp2_is_exact_at_whole_numbers() -> None:
    whole = np.resize(np.arange(-126, 127 + 1), 256)
    assert np.array_equal(exp2_of(whole), np.ldexp(np.float32(1), whole))


@given(vectors, vectors, finite.filter(bool))
@settings(max_examples=50, deadline=None)
def test_arithmetic_with_vectors_and_scalars(x: Floats, y: Floats, s: float) -> None:
    y = np.where(np.abs(y) < 1e-3, np.float32(1), y)
    s, out = np.float32(s), np.empty(8 * LANES, np.float32)
    apply_arithmetic(x, y, s, out)
    with np.errstate(over="ignore"):
        expected = np.stack([x + y, x - y, x * y, x / y, x + s, s - x, x * s, s / y])
    np.testing.assert_allclose(out.reshape(8, LANES), expected, rtol=1e-6, atol=1e-30)


@given(any_vectors, any_vectors, vectors)
@settings(max_examples=50, deadline=None)
def test_comparisons_choose_lane_by_lane(x: Floats, y: Floats, value: Floats) -> None:
    """Where a lane is NaN no comparison holds: minimum and maximum then give their second."""
    out = np.empty(4 * LANES, np.float32)
    apply_choices(x, y, value, out)
    least, most, where_ge, where_positive = out.reshape(4, LANES)
    assert np.array_equal(least, np.where(x < y, x, y), equal_nan=True)
    assert np.array_equal(most, np.where(x > y, x, y), equal_nan=True)
    assert np.array_equal(where_ge, np.where(x >= y, value, 0))
    assert np.array_equal(where_positive, np.where(x > 0, value, 0))


def test_where_ge_includes_equality_and_excludes_nan() -> None:
    x = np.tile(np.array([1, 2, 3, np.nan], np.float32), 4)
    y, value = np.full(LANES, 2, np.float32), np.arange(LANES, dtype=np.float32) + 1
    out = np.empty(4 * LANES, np.float32)
    apply_choices(x, y, value, out)
    assert out[32:36].tolist() == [0, 2, 3, 0]


@given(vectors)
@settings(max_examples=50, deadline=None)
def test_reductions(x: Floats) -> None:
    total, largest = apply_reductions(x)
    exact = x.astype(np.float64)
    assert abs(total - exact.sum()) <= 1e-6 * np.abs(exact).sum() + 1e-30
    assert largest == x.max()


@pytest.mark.parametrize("apply", [apply_reduce_sums_1, apply_reduce_sums_9])
def test_reduce_sums_puts_one_sum_in_each_lane(apply: Any) -> None:
    count = 1 if apply is apply_reduce_sums_1 else 9
    x = np.random.default_rng(count).normal(size=(9, LANES)).astype(np.float32)
    out = np.full(LANES, -1, np.float32)
    apply(x, out)
    np.testing.assert_allclose(out[:count], x[:count].sum(axis=1), atol=1e-5)
    assert not out[count:].any()


def test_sqrt() -> None:
    x = np.exp(np.linspace(-30, 30, LANES)).astype(np.float32)
    out = np.empty_like(x)
    apply_sqrt(x, out)
    np.testing.assert_allclose(out, np.sqrt(x), rtol=2e-7)


def test_iota_and_splat() -> None:
    out = np.empty(2 * LANES, np.float32)
    apply_fill(np.float32(2.5), 3, out)
    assert np.array_equal(out[:LANES], 2.5 + np.arange(LANES))
    assert np.array_equal(out[LANES:], np.full(LANES, 3))


@pytest.mark.parametrize(("at", "to"), [(0, 0), (1, 0), (7, 3), (16, 15)])
def test_load_and_store_touch_16_floats_at_any_offset(at: int, to: int) -> None:
    x = np.arange(40, dtype=np.float32)
    out = np.full(40, -1, np.float32)
    copy_lanes(x, at, out, to)
    expected = np.full(40, -1, np.float32)
    expected[to : to + LANES] = x[at : at + LANES]
    assert np.array_equal(out, expected)


@pytest.mark.parametrize("at", [0, 1, 13, 240])
def test_load_bytes_takes_all_values_as_floats(at: int) -> None:
    x, out = np.arange(256, dtype=np.uint8), np.empty(LANES, np.float32)
    bytes_as_floats(x, at, out)
    assert np.array_equal(out, np.arange(at, at + LANES))


def test_two_dimensional_arrays_are_indexed_flat() -> None:
    x = np.arange(64, dtype=np.float32).reshape(4, 16)
    out = np.zeros((2, 16), np.float32)
    copy_lanes(x, 24, out, 8)
    assert np.array_equal(out.ravel()[8:24], x.ravel()[24:40])


def applied(rows: int, columns: int) -> Any:
    """Return a kernel that does nothing but one tile."""
    tile = make_product_tile(rows, columns)

    @numba.njit
    def apply(a, a0, a_row, a_step, b, b0, b_step, count, c, c0, c_row):
        tile(a, a0, a_row, a_step, b, b0, b_step, count, c, c0, c_row)

    return apply


TILES = {shape: applied(*shape) for shape in ((4, 4), (8, 2), (8, 1), (1, 4), (1, 2), (1, 1))}


@pytest.mark.parametrize("transposed", [False, True])
@pytest.mark.parametrize("count", [0, 1, 37])
@pytest.mark.parametrize("shape", list(TILES), ids=str)
def test_product_tile_adds_a_matrix_product(
    shape: tuple[int, int], count: int, transposed: bool
) -> None:
    """On parts of larger arrays, ``a`` row by row or column by column; the rest stays."""
    rows, columns = shape
    rng, width = np.random.default_rng(count), LANES * columns
    a = rng.normal(size=(count + 3, rows + 2) if transposed else (rows + 2, count + 3))
    b, c = rng.normal(size=(count + 2, width + 16)), rng.normal(size=(rows + 2, width + 16))
    a, b, c = (x.astype(np.float32) for x in (a, b, c))
    before = c.copy()
    inner = a[2 : 2 + count, 1 : 1 + rows].T if transposed else a[1 : 1 + rows, 2 : 2 + count]
    stride = a.shape[1]
    a0, a_row, a_step = (2 * stride + 1, 1, stride) if transposed else (stride + 2, stride, 1)
    b0, c0 = b.shape[1] + 8, c.shape[1] + 5
    TILES[shape](
        a.ravel(), a0, a_row, a_step, b.ravel(), b0, b.shape[1], count, c.ravel(), c0, c.shape[1]
    )
    product = inner.astype(np.float64) @ b[1 : 1 + count, 8 : 8 + width].astype(np.float64)
    expected = before.copy()
    expected[1 : 1 + rows, 5 : 5 + width] += product.astype(np.float32)
    np.testing.assert_allclose(c, expected, atol=1e-4 if count > 1 else 1e-6)
    outside = np.ones(c.shape, bool)
    outside[1 : 1 + rows, 5 : 5 + width] = False
    assert np.array_equal(c[outside], before[outside])
