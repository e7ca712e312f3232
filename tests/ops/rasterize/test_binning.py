"""Binning: nothing visible is left out, and the lists are in the order that blending needs."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from gsdmsr_cli.backends.cpu.jit import threads
from gsdmsr_cli.ground.splatting_constants import ALPHA_MIN, TILE
from gsdmsr_cli.ops.rasterize.cpu import projection
from gsdmsr_cli.ops.rasterize.cpu.binning import Bins, bin_splats, depth_order, leave_out

WIDTHS = [1, 15, 16, 17, 33, 50]

Screen = tuple[NDArray[np.float32], ...]  # means2d, conics, depths, opacities, tiles


def projected(
    count: int, width: int, height: int, seed: int, size: float, stretch: float = 0.7
) -> Screen:
    """Return random splats on the screen; ``stretch`` is the sigma of the log of their scales."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(count, 3)) * [1.2, 1.2, 1.0]
    log_scales = np.log(size) + stretch * rng.normal(size=(count, 3))
    quats, logits = rng.normal(size=(count, 4)), rng.normal(size=count) * 3
    sh = np.zeros((count, 1, 3))
    stored = [x.astype(np.float32) for x in (means, quats, log_scales, logits, sh)]
    view = np.eye(4, dtype=np.float32)[:3]
    view[2, 3] = 3.5
    focal = 1.1 * max(width, height)
    intrinsics = np.array([focal, focal, width / 2, height / 2], np.float32)
    means2d, conics = np.empty((count, 2), np.float32), np.empty((count, 3), np.float32)
    depths, opacities, radii = (np.empty(count, np.float32) for _ in range(3))
    tiles = np.empty(count, np.int32)
    projection.project(
        *stored, None, view, intrinsics, width, height,
        means2d, conics, depths, opacities, radii, tiles,
    )  # fmt: skip
    return means2d, conics, depths, opacities, tiles


def radii_of(screen: Screen) -> NDArray[np.float32]:
    """Return the half extents (N,) that ``project`` gives, 0 for splats that are not drawn."""
    _, conics, _, opacities, _ = (x.astype(np.float64) for x in screen)
    extent = 2 * np.log(np.maximum(opacities / ALPHA_MIN, 1))
    a, b, c = conics.T
    det = np.where(opacities > 0, a * c - b * b, 1)
    return np.sqrt(extent * np.maximum(a, c) / det).astype(np.float32)


def alphas(screen: Screen, width: int, height: int) -> NDArray[np.float64]:
    """Return the (N, H, W) alphas at the pixel centres, 0 for splats that are not drawn."""
    means2d, conics, _, opacities, tiles = (x.astype(np.float64) for x in screen)
    x = np.arange(width) + 0.5 - means2d[:, 0, None, None]
    y = (np.arange(height) + 0.5)[:, None] - means2d[:, 1, None, None]
    a, b, c = (conics[:, k, None, None] for k in range(3))
    alpha = opacities[:, None, None] * np.exp(-0.5 * (a * x * x + 2 * b * x * y + c * y * y))
    return np.where(tiles[:, None, None] > 0, alpha, 0)


def listed(bins: Bins, count: int, width: int, height: int) -> NDArray[np.bool_]:
    """Return (N, H, W) which pixels the lists make blending look at."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    seen = np.zeros((count, rows * TILE, columns * TILE), bool)
    for tile in range(rows * columns):
        top, left = tile // columns * TILE, tile % columns * TILE
        for splat, span in bins.entries[bins.starts[tile] : bins.starts[tile + 1]]:
            first, last = span & 255, span >> 8
            assert 0 <= first <= last < TILE
            rows_of_tile = seen[splat, top + first : top + last + 1, left : left + TILE]
            assert not rows_of_tile.any(), "a splat is listed twice in a tile"
            rows_of_tile[:] = True
    return seen[:, :height, :width]


sizes = st.sampled_from(WIDTHS)


@given(sizes, sizes, st.integers(0, 40), st.integers(0, 999), st.sampled_from([0.01, 0.1, 0.5, 3]))
@settings(max_examples=60, deadline=None)
def test_every_visible_pixel_is_in_a_listed_row(
    width: int, height: int, count: int, seed: int, size: float
) -> None:
    screen = projected(count, width, height, seed, size)
    bins = bin_splats(*screen, width, height)
    # at the very cut-off float32 may decide either way
    visible = alphas(screen, width, height) >= ALPHA_MIN * (1 + 1e-4)
    missed = visible & ~listed(bins, count, width, height)
    assert not missed.any(), np.argwhere(missed)[:5]


@given(st.integers(0, 999))
@settings(max_examples=20, deadline=None)
def test_every_visible_pixel_of_needles_is_in_a_listed_row(seed: int) -> None:
    screen = projected(30, 50, 37, seed, 0.05, stretch=2.5)
    visible = alphas(screen, 50, 37) >= ALPHA_MIN * (1 + 1e-4)
    assert visible.any()
    assert not (visible & ~listed(bin_splats(*screen, 50, 37), 30, 50, 37)).any()


@given(sizes, sizes, st.integers(0, 60), st.integers(0, 999))
@settings(max_examples=40, deadline=None)
def test_lists_are_whole_and_in_order(width: int, height: int, count: int, seed: int) -> None:
    screen = projected(count, width, height, seed, 0.2)
    depths, tiles = screen[2], screen[4]
    bins = bin_splats(*screen, width, height)
    tile_count = -(-width // TILE) * -(-height // TILE)
    lengths = np.diff(bins.starts)
    assert bins.starts[0] == 0 and bins.starts[-1] == len(bins.entries)
    assert len(lengths) == tile_count and (lengths >= 0).all()
    assert sorted(bins.busiest) == list(range(tile_count))
    assert (np.diff(lengths[bins.busiest]) <= 0).all()
    for start, end in zip(bins.starts[:-1], bins.starts[1:], strict=True):
        assert (np.diff(depths[bins.entries[start:end, 0]]) >= 0).all()
    assert set(bins.splats) == set(np.flatnonzero(tiles))
    assert (np.diff(depths[bins.splats]) >= 0).all()


def test_a_round_splat_inside_a_tile_is_listed_there_with_its_rows_only() -> None:
    means2d = np.array([[24.0, 24.0]], np.float32)  # the centre of tile (1, 1) of 3 x 3
    conics = np.array([[1.0, 0.0, 1.0]], np.float32)
    opacity = np.array([0.9], np.float32)
    reach = np.sqrt(2 * np.log(0.9 / ALPHA_MIN))  # 3.3 px: centres from 20.5 + 0.2 on
    bins = bin_splats(
        means2d, conics, np.ones(1, np.float32), opacity, np.ones(1, np.int32), 48, 48
    )
    assert np.array_equal(np.diff(bins.starts), [0, 0, 0, 0, 1, 0, 0, 0, 0])
    first, last = int(np.ceil(24 - reach - 0.5)) - 16, int(np.floor(24 + reach - 0.5)) - 16
    assert bins.entries.tolist() == [[0, first | last << 8]]


def test_a_diagonal_needle_is_listed_along_the_diagonal_only() -> None:
    """Its box touches 64 tiles; the needle itself passes through 22 of them at most."""
    along, across = 30.0**2, 0.5**2
    same, other = 0.5 * (along + across), 0.5 * (along - across)
    inverse = np.linalg.inv(np.array([[same, other], [other, same]]))
    conics = np.array([[inverse[0, 0], inverse[0, 1], inverse[1, 1]]], np.float32)
    bins = bin_splats(
        np.array([[64.0, 64.0]], np.float32), conics, np.ones(1, np.float32),
        np.array([0.99], np.float32), np.array([64], np.int32), 128, 128,
    )  # fmt: skip
    tiles = np.flatnonzero(np.diff(bins.starts))
    assert set(range(0, 64, 9)) <= set(tiles) and len(tiles) <= 22


def test_depths_sort_front_to_back_with_ties_by_row() -> None:
    depths = np.array([3.0, 0.5, 3.0, 1e-3, 2.0, 7e30, 0.5], np.float32)
    tiles = np.array([1, 2, 1, 1, 0, 1, 1], np.int32)
    assert depth_order(depths, tiles).tolist() == [3, 1, 6, 0, 2, 5]


def test_lists_do_not_depend_on_the_number_of_threads() -> None:
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("numba was started with one thread")
    screen, before, found = projected(500, 70, 50, 1, 0.1), threads(), []
    try:
        for count in (1, 2):
            numba.set_num_threads(count)
            found.append(bin_splats(*screen, 70, 50))
    finally:
        numba.set_num_threads(before)
    for one, two in zip(*found, strict=True):
        assert np.array_equal(one, two)


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(WIDTHS), st.sampled_from(WIDTHS), st.integers(0, 2**16), st.floats(0, 1))
def test_only_splats_that_touch_no_tile_with_a_weight_are_left_out(
    width: int, height: int, seed: int, share: float
) -> None:
    screen = projected(60, width, height, seed, size=0.03)
    columns, rows = -(-width // TILE), -(-height // TILE)
    draws = np.random.default_rng(seed).random(rows * columns)
    weights = np.where(draws < share, 3.0, 0).astype(np.float32)
    wanted = np.repeat(np.repeat(weights.reshape(rows, columns) > 0, TILE, 0), TILE, 1)
    needed = (alphas(screen, width, height) >= ALPHA_MIN) & wanted[:height, :width]
    means2d, _, _, opacities, tiles = (x.copy() for x in screen)
    leave_out(means2d, radii_of(screen), width, height, weights, opacities, tiles)
    left = (screen[4] > 0) & (tiles == 0)
    assert not (left & needed.any(axis=(1, 2))).any()
    assert (opacities[left] == 0).all() and (tiles[~left] == screen[4][~left]).all()
    if not (weights > 0).any():
        assert not tiles.any()
    if (weights > 0).all():
        assert not left.any()
