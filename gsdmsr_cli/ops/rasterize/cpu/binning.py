"""Assigns splats to the 16 x 16 tiles they touch, front to back in every tile.

The splats are sorted by depth once; each thread then appends the tiles of its share of the sorted
splats to its own list, and a stable scatter brings the lists into tile order. So nothing is sorted
per tile, and the order inside a tile is that of depth, however many threads there are.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import float32, prange
from numpy.typing import NDArray

from gsdmsr_cli.backends.cpu.jit import inline, parallel, serial, threads
from gsdmsr_cli.ground.splatting_constants import ALPHA_MIN, TILE
from gsdmsr_cli.ops.rasterize.cpu.projection import ROUNDING, pixel_range

_ALPHA_MIN = float32(ALPHA_MIN)
_ROUNDING = float32(ROUNDING)
_HALF = float32(0.5)
_BITS = 11
_RADIX = 1 << _BITS
_MASK = np.uint32(_RADIX - 1)


class Bins(NamedTuple):
    """Which splats touch which tile.

    Attributes:
        entries: (E, 2) int32 in tile order: splat, first | last << 8 row inside the tile.
        starts: (tiles + 1,) int32, where each tile's entries start; tiles are row by row.
        busiest: (tiles,) int32, the tiles by falling number of entries.
        splats: (n,) int32, the drawn splats, front to back.
    """

    entries: NDArray[np.int32]
    starts: NDArray[np.int32]
    busiest: NDArray[np.int32]
    splats: NDArray[np.int32]


@serial
def _sorted_rows(rows, keys):
    """Return int32 rows by rising uint32 key, one key per row, ties in the order given.

    A radix sort: three passes over 11 bits each.
    """
    n = rows.shape[0]
    other_rows, other_keys = np.empty_like(rows), np.empty_like(keys)
    heads = np.empty(_RADIX, np.int64)
    for turn in range(3):
        shift = np.uint32(_BITS * turn)
        heads[:] = 0
        for k in range(n):
            heads[(keys[k] >> shift) & _MASK] += 1
        total = 0
        for digit in range(_RADIX):
            count = heads[digit]
            heads[digit] = total
            total += count
        for k in range(n):
            digit = (keys[k] >> shift) & _MASK
            at = heads[digit]
            heads[digit] = at + 1
            other_rows[at], other_keys[at] = rows[k], keys[k]
        rows, other_rows = other_rows, rows
        keys, other_keys = other_keys, keys
    return rows


@serial
def depth_order(depths, tiles):
    """Return the rows with tiles > 0 by rising depth, ties by row; depths are positive there."""
    count = 0
    for i in range(tiles.shape[0]):
        count += tiles[i] > 0
    rows, keys = np.empty(count, np.int32), np.empty(count, np.uint32)
    bits, at = depths.view(np.uint32), 0
    for i in range(tiles.shape[0]):
        if tiles[i] > 0:
            rows[at], keys[at] = i, bits[i]  # the bits of a positive float sort like the float
            at += 1
    return _sorted_rows(rows, keys)


@inline
def _rows_of_column(a, b, c, det, extent, reach, half_x, slope, low, high, centre_y, height):
    """Return the pixel rows that the ellipse touches between x = low and x = high.

    The ellipse is a x^2 + 2 b x y + c y^2 = extent around (0, centre_y); it reaches x = +-half_x
    and is highest at x = slope, lowest at x = -slope. Its rim at x is
    y = (-b x +- sqrt(extent c - det x^2)) / c.
    """
    low, high = max(low, -half_x), min(high, half_x)
    x_top, x_bottom = min(max(-slope, low), high), min(max(slope, low), high)
    inverse_c = float32(1) / c
    y_top = (-b * x_top - math.sqrt(max(reach - det * x_top * x_top, float32(0)))) * inverse_c
    y_bottom = (-b * x_bottom + math.sqrt(max(reach - det * x_bottom * x_bottom, float32(0)))) * (
        inverse_c
    )
    first, _ = pixel_range(centre_y + y_top, float32(0), height)
    _, last = pixel_range(centre_y + y_bottom, float32(0), height)
    return first, last


@parallel
def _list_tiles(
    order, means2d, conics, opacities, width, height, chunks, bounds, pairs, counts, listed
):
    """Append (splat, tile << 8 | rows) of every touched tile to the chunk's part of ``pairs``."""
    n = order.shape[0]
    columns = (width + TILE - 1) // TILE
    for chunk in prange(chunks):
        counts[chunk, :] = 0
        at = bounds[n * chunk // chunks]
        for k in range(n * chunk // chunks, n * (chunk + 1) // chunks):
            i = order[k]
            a, b, c = conics[i, 0], conics[i, 1], conics[i, 2]
            mx, my = means2d[i, 0], means2d[i, 1]
            extent = float32(2) * math.log(opacities[i] / _ALPHA_MIN)
            det = max(a * c - b * b, float32(1e-30))
            half_x, half_y = math.sqrt(extent * c / det), math.sqrt(extent * a / det)
            left, right = pixel_range(mx, half_x, width)
            slope = -b / a * half_y
            for tx in range(left // TILE, right // TILE + 1):
                low = float32(tx * TILE) + _HALF - mx - _ROUNDING
                high = float32(tx * TILE + TILE) - _HALF - mx + _ROUNDING
                if left // TILE == right // TILE:  # one column holds the whole ellipse
                    top, bottom = pixel_range(my, half_y, height)
                else:
                    top, bottom = _rows_of_column(
                        a, b, c, det, extent, extent * c, half_x, slope, low, high, my, height
                    )
                if bottom < top:
                    continue
                for ty in range(top // TILE, bottom // TILE + 1):
                    tile = ty * columns + tx
                    first, last = max(top - ty * TILE, 0), min(bottom - ty * TILE, TILE - 1)
                    counts[chunk, tile] += 1
                    pairs[at, 0] = i
                    pairs[at, 1] = tile << 8 | first << 4 | last
                    at += 1
        listed[chunk] = at


@serial
def _scan(counts, starts):
    """Turn the counts per chunk and tile into where each chunk writes its first entry."""
    total = 0
    for tile in range(counts.shape[1]):
        starts[tile] = total
        for chunk in range(counts.shape[0]):
            count = counts[chunk, tile]
            counts[chunk, tile] = total
            total += count
    starts[counts.shape[1]] = total
    return total


@parallel
def _scatter(pairs, order_size, chunks, bounds, listed, heads, entries):
    """Copy every chunk's pairs to their tiles."""
    for chunk in prange(chunks):
        for m in range(bounds[order_size * chunk // chunks], listed[chunk]):
            code = pairs[m, 1]
            tile = code >> 8
            at = heads[chunk, tile]
            heads[chunk, tile] = at + 1
            entries[at, 0] = pairs[m, 0]
            entries[at, 1] = ((code >> 4) & 15) | ((code & 15) << 8)


@serial
def leave_out(means2d, radii, width, height, tile_weights, opacities, tiles):
    """Do not draw splats whose box lies in tiles of weight 0 alone: nothing is asked of them.

    Args:
        means2d, radii, width, height: see ``projection.project``.
        tile_weights: (tiles,) float32.
        opacities: (N,) in and out, 0 where the splat is not drawn.
        tiles: (N,) int32 in and out, likewise.
    """
    columns, rows = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    counts = np.zeros((rows + 1, columns + 1), np.int32)  # of those with a weight, up and left
    for row in range(rows):
        for column in range(columns):
            own = np.int32(tile_weights[row * columns + column] > 0)
            before = counts[row, column + 1] + counts[row + 1, column] - counts[row, column]
            counts[row + 1, column + 1] = before + own
    for i in range(tiles.shape[0]):
        if tiles[i] == 0:
            continue
        left, right = pixel_range(means2d[i, 0], radii[i], width)
        top, bottom = pixel_range(means2d[i, 1], radii[i], height)
        x0, x1, y0, y1 = left // TILE, right // TILE + 1, top // TILE, bottom // TILE + 1
        if counts[y1, x1] - counts[y0, x1] - counts[y1, x0] + counts[y0, x0] == 0:
            opacities[i], tiles[i] = float32(0), 0


@serial
def assign(means2d, conics, depths, opacities, tiles, width, height, chunks):
    """Return what ``bin_splats`` does, as a plain tuple; ``chunks`` is the number of threads."""
    order = depth_order(depths, tiles)
    n = order.shape[0]
    tile_count = ((width + TILE - 1) // TILE) * ((height + TILE - 1) // TILE)
    bounds = np.empty(n + 1, np.int64)
    bounds[0] = 0
    for k in range(n):
        bounds[k + 1] = bounds[k] + tiles[order[k]]
    pairs = np.empty((max(bounds[n], 1), 2), np.int32)
    counts = np.empty((chunks, tile_count), np.int32)
    listed = np.empty(chunks, np.int64)
    starts = np.empty(tile_count + 1, np.int32)
    _list_tiles(
        order, means2d, conics, opacities, width, height, chunks, bounds, pairs,
        counts, listed,
    )  # fmt: skip
    total = _scan(counts, starts)
    entries = np.empty((total, 2), np.int32)
    _scatter(pairs, n, chunks, bounds, listed, counts, entries)
    rows, fullness = np.empty(tile_count, np.int32), np.empty(tile_count, np.uint32)
    for tile in range(tile_count):
        rows[tile], fullness[tile] = tile, total - (starts[tile + 1] - starts[tile])
    return entries, starts, _sorted_rows(rows, fullness), order


def bin_splats(
    means2d: NDArray[np.float32],
    conics: NDArray[np.float32],
    depths: NDArray[np.float32],
    opacities: NDArray[np.float32],
    tiles: NDArray[np.int32],
    width: int,
    height: int,
) -> Bins:
    """Sort N projected splats (see ``projection.project``) into tiles."""
    return Bins(*assign(means2d, conics, depths, opacities, tiles, width, height, threads()))
