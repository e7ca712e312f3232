"""Blends binned splats front to back, 16 pixels of a tile row at a time, and back again (3DGS).

A tile is 16 rows of one vector each, held in a small block that stays in the first-level cache. A
splat touches only the rows its ellipse reaches. Every 16 splats the finished rows at the top and
the bottom of the tile are dropped; a tile ends when all rows are finished.

The backward pass walks front to back as well: it carries what is left of the pixel's colour, so
that nothing per pixel and splat has to be stored.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import float32, prange

from gsdmsr_cli.backends.cpu import simd
from gsdmsr_cli.backends.cpu.jit import inline, parallel
from gsdmsr_cli.ground.splatting_constants import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_STOP
from gsdmsr_cli.ops.photometric.cpu import distances, load_target

RECORD = 16
"""Floats per splat record: one cache line, of which nine are used."""

WEIGHTED = 9
"""How many of a splat's sums a tile's weight in the loss applies to; the two after them are those
of e dx and e dy without it."""

PARTS = 4
"""Parts of the picture whose gradients are summed apart, and so the most threads of the backward
pass. A fixed number: then the sums do not depend on how many threads there are."""

_AHEAD = 8
"""How many entries before its turn a splat's record is asked for, which may lie in slow memory."""

_LOG2E = float32(math.log2(math.e))
_ALPHA_MIN = float32(ALPHA_MIN)
_ALPHA_MAX = float32(ALPHA_MAX)
_STOP = float32(TRANSMITTANCE_STOP)
_HALF = float32(0.5)
_BLOCK = TILE * TILE


@parallel
def pack(splats, means2d, conics, opacities, colours, records):
    """Write what blending needs of each splat to one cache line.

    The exponent is in powers of two: alpha = 2^(r5 + r2 dx^2 + r3 dx dy + r4 dy^2).
    """
    for k in prange(splats.shape[0]):
        i = splats[k]
        records[i, 0], records[i, 1] = means2d[i, 0], means2d[i, 1]
        records[i, 2] = -_HALF * _LOG2E * conics[i, 0]
        records[i, 3] = -_LOG2E * conics[i, 1]
        records[i, 4] = -_HALF * _LOG2E * conics[i, 2]
        records[i, 5] = math.log2(opacities[i])
        for channel in range(3):
            records[i, 6 + channel] = colours[i, channel]


@inline
def _unfinished_rows(block, first, last):
    """Shrink the range of tile rows while all pixels of its outer rows are finished."""
    while first <= last and simd.reduce_max(simd.load(block, first * TILE)) < _STOP:
        first += 1
    while last >= first and simd.reduce_max(simd.load(block, last * TILE)) < _STOP:
        last -= 1
    return first, last


@inline
def _corner(tile, columns):
    """Return the tile's row and column, and the centre of its first pixel."""
    tile_y, tile_x = tile // columns, tile % columns
    return tile_y, tile_x, float32(tile_x * TILE) + _HALF, float32(tile_y * TILE) + _HALF


def _make_draw(keep: bool) -> Any:
    """Make the drawing of a tile, which may keep what ``_make_differentiate`` needs again.

    Computing the falloffs twice would take a fifth of the time of drawing and gradients.
    """

    @inline
    def draw(block, kept, ranges, records, entries, start, end, x0, y0):
        """Blend a tile's entries into a block of transmittance, red, green and blue.

        Returns the entry after the last one blended. ``kept`` has room for a whole tile of
        falloffs, opacity times Gaussian, for each entry; ``ranges`` for the first and the last row
        that every 16 entries were blended into.
        """
        one, zero = simd.splat(float32(1)), simd.splat(float32(0))
        cut, full, floor = simd.splat(_ALPHA_MIN), simd.splat(_ALPHA_MAX), simd.splat(float32(-126))
        for y in range(TILE):
            simd.store(block, y * TILE, one)
            simd.store(block, _BLOCK + y * TILE, zero)
            simd.store(block, 2 * _BLOCK + y * TILE, zero)
            simd.store(block, 3 * _BLOCK + y * TILE, zero)
        top, bottom, at = 0, TILE - 1, 0
        k = start
        while k < end:
            if ((k - start) & 15) == 0 and k > start:
                top, bottom = _unfinished_rows(block, top, bottom)
                if top > bottom:
                    break
            if keep:
                ranges[(k - start) >> 4, 0], ranges[(k - start) >> 4, 1] = top, bottom
            i, rows = entries[k, 0], entries[k, 1]
            simd.prefetch(records, entries[min(k + _AHEAD, end - 1), 0] * RECORD)
            k += 1
            dx = simd.iota(x0 - records[i, 0])
            at_row = dx * dx * records[i, 2] + simd.splat(records[i, 5])
            slope, curve = dx * records[i, 3], records[i, 4]
            red, green, blue = records[i, 6], records[i, 7], records[i, 8]
            for y in range(max(rows & 255, top), min(rows >> 8, bottom) + 1):
                dy = y0 + float32(y) - records[i, 1]
                power = at_row + (slope + simd.splat(curve * dy)) * dy
                free = simd.exp2(simd.maximum(power, floor))
                if keep:
                    simd.store(kept, at, free)
                    at += TILE
                alpha = simd.minimum(free, full)
                alpha = simd.where_ge(alpha, cut, alpha)
                o = y * TILE
                before = simd.load(block, o)
                weight = alpha * before
                simd.store(block, o, before - weight)
                o += _BLOCK
                simd.store(block, o, simd.load(block, o) + weight * red)
                o += _BLOCK
                simd.store(block, o, simd.load(block, o) + weight * green)
                o += _BLOCK
                simd.store(block, o, simd.load(block, o) + weight * blue)
        return k

    return draw


def _make_differentiate(from_kept: bool) -> Any:
    """Make the gradients of a tile, from falloffs that are kept or computed again.

    Which rows were blended is kept with them: two loops that find it out by the transmittance, each
    compiled by itself, could differ in its last bit, and so in where a falloff lies.
    """

    @inline
    def differentiate(block, kept, ranges, records, entries, start, end, x0, y0, tile_weight, own):
        """Add a tile's shares of the gradients of its splats to ``own``.

        The block holds the transmittance, 1 at first, what is left of d_rgb . rgb, and d_rgb.
        """
        factors = simd.first_lanes(WEIGHTED) * (tile_weight - float32(1)) + simd.splat(float32(1))
        one, zero = simd.splat(float32(1)), simd.splat(float32(0))
        cut, full, floor = simd.splat(_ALPHA_MIN), simd.splat(_ALPHA_MAX), simd.splat(float32(-126))
        top, bottom, at = 0, TILE - 1, 0
        for k in range(start, end):
            if from_kept:
                top, bottom = ranges[(k - start) >> 4, 0], ranges[(k - start) >> 4, 1]
            elif ((k - start) & 15) == 0 and k > start:
                top, bottom = _unfinished_rows(block, top, bottom)
            i, rows = entries[k, 0], entries[k, 1]
            later = entries[min(k + _AHEAD, end - 1), 0] * RECORD
            simd.prefetch(records, later)
            simd.prefetch(own, later)
            dx = simd.iota(x0 - records[i, 0])
            at_row = dx * dx * records[i, 2] + simd.splat(records[i, 5])
            slope, curve = dx * records[i, 3], records[i, 4]
            red, green, blue = records[i, 6], records[i, 7], records[i, 8]
            sum_e, sum_ey, sum_eyy = zero, zero, zero
            sum_red, sum_green, sum_blue = zero, zero, zero
            for y in range(max(rows & 255, top), min(rows >> 8, bottom) + 1):
                dy = y0 + float32(y) - records[i, 1]
                if from_kept:
                    free = simd.load(kept, at)
                    at += TILE
                else:
                    power = at_row + (slope + simd.splat(curve * dy)) * dy
                    free = simd.exp2(simd.maximum(power, floor))
                alpha = simd.minimum(free, full)
                alpha = simd.where_ge(alpha, cut, alpha)
                o = y * TILE
                before, left = simd.load(block, o), simd.load(block, _BLOCK + o)
                d_red = simd.load(block, 2 * _BLOCK + o)
                d_green = simd.load(block, 3 * _BLOCK + o)
                d_blue = simd.load(block, 4 * _BLOCK + o)
                weight = alpha * before
                share = (d_red * red + d_green * green + d_blue * blue) * weight
                left = left - share
                simd.store(block, o, before - weight)
                simd.store(block, _BLOCK + o, left)
                e = simd.where_ge(full, free, share - alpha * left / (one - alpha))
                ey = e * dy
                sum_e, sum_ey, sum_eyy = sum_e + e, sum_ey + ey, sum_eyy + ey * dy
                sum_red, sum_green = sum_red + weight * d_red, sum_green + weight * d_green
                sum_blue = sum_blue + weight * d_blue
            sum_ex = sum_e * dx
            shares = simd.reduce_sums(
                sum_e, sum_ex, sum_ey, sum_ex * dx, sum_ey * dx, sum_eyy,
                sum_red, sum_green, sum_blue, sum_ex, sum_ey,
            )  # fmt: skip
            simd.store(own, i * RECORD, simd.load(own, i * RECORD) + shares * factors)

    return differentiate


_draw, _draw_and_keep = _make_draw(False), _make_draw(True)
_differentiate, _differentiate_kept = _make_differentiate(False), _make_differentiate(True)


@parallel
def blend(records, entries, starts, busiest, lanes, columns, background, rgb, alpha, ends):
    """Draw every tile.

    Args:
        records: (N, 16) float32 from ``pack``.
        entries, starts, busiest: see ``binning.Bins``.
        lanes: how many threads take tiles in turns.
        columns: tiles in a row.
        background: (3,) float32.
        rgb: (3, H', W') float32 out, H' and W' rounded up to whole tiles.
        alpha: (H', W') float32 out, what the splats cover.
        ends: (tiles,) int32 out, the entry after the last one blended.
    """
    stride = rgb.shape[2]
    plane = rgb.shape[1] * stride
    pixels, cover = rgb.reshape(-1), alpha.reshape(-1)
    for lane in prange(lanes):
        block, unused = np.empty(4 * _BLOCK, np.float32), np.empty((0, 2), np.int32)
        one = simd.splat(float32(1))
        for turn in range(lane, busiest.shape[0], lanes):
            tile = busiest[turn]
            tile_y, tile_x, x0, y0 = _corner(tile, columns)
            ends[tile] = _draw(
                block, block, unused, records, entries, starts[tile], starts[tile + 1], x0, y0
            )
            for y in range(TILE):
                o = (tile_y * TILE + y) * stride + tile_x * TILE
                left = simd.load(block, y * TILE)
                simd.store(cover, o, one - left)
                for channel in range(3):
                    shade = simd.load(block, (1 + channel) * _BLOCK + y * TILE)
                    simd.store(pixels, channel * plane + o, shade + left * background[channel])


@parallel
def blend_backward(
    records, entries, starts, busiest, ends, columns, rgb, alpha, d_rgb, d_alpha, sums
):
    """Sum every splat's share of the gradients over the pixels of each part of the picture.

    With e = alpha dL/dalpha of a pixel, the sums are those of e, e dx, e dy, e dx^2, e dx dy,
    e dy^2 and of weight times d_rgb, then those of e dx and e dy again. Saturated pixels have
    e = 0.

    Args:
        d_rgb: (3, H', W') float32, 0 outside the picture.
        d_alpha: (H', W') float32, 0 outside the picture, or (0, 0) if it is 0 everywhere.
        sums: (PARTS, N, 16) float32 out, of which eleven columns are used.
        others: see ``blend``.
    """
    stride = rgb.shape[2]
    plane = rgb.shape[1] * stride
    pixels, cover = rgb.reshape(-1), alpha.reshape(-1)
    d_pixels, d_cover, covered = d_rgb.reshape(-1), d_alpha.reshape(-1), d_alpha.shape[0] > 0
    for part in prange(PARTS):
        own = sums[part].reshape(-1)
        own[:] = float32(0)
        block, unused = np.empty(5 * _BLOCK, np.float32), np.empty((0, 2), np.int32)
        one = simd.splat(float32(1))
        for turn in range(part, busiest.shape[0], PARTS):
            tile = busiest[turn]
            tile_y, tile_x, x0, y0 = _corner(tile, columns)
            start, end = starts[tile], ends[tile]
            if start == end:
                continue
            for y in range(TILE):
                o = (tile_y * TILE + y) * stride + tile_x * TILE
                d_red, d_green = simd.load(d_pixels, o), simd.load(d_pixels, o + plane)
                d_blue = simd.load(d_pixels, o + 2 * plane)
                left = (
                    d_red * simd.load(pixels, o)
                    + d_green * simd.load(pixels, o + plane)
                    + d_blue * simd.load(pixels, o + 2 * plane)
                )
                if covered:
                    left = left - simd.load(d_cover, o) * (one - simd.load(cover, o))
                simd.store(block, y * TILE, one)
                simd.store(block, _BLOCK + y * TILE, left)
                simd.store(block, 2 * _BLOCK + y * TILE, d_red)
                simd.store(block, 3 * _BLOCK + y * TILE, d_green)
                simd.store(block, 4 * _BLOCK + y * TILE, d_blue)
            _differentiate(
                block, block, unused, records, entries, start, end, x0, y0, float32(1), own
            )


@inline
def _compare_plain(row, target, background, top, left, bottom, right, steep, half):
    """Return the sum of the background's distances over a tile that no splat touches."""
    pixels, width, plane = target.reshape(-1), target.shape[2], target.shape[1] * target.shape[2]
    total, covered = simd.splat(float32(0)), simd.first_lanes(right - left)
    for channel in range(3):
        shade = covered * background[channel]
        for y in range(top, bottom):
            at = channel * plane + y * width + left
            wanted = load_target(pixels, at, right - left, row)
            total = total + distances(shade - wanted, float32(0), steep, half)[0]
    return simd.reduce_sum(total)


@inline
def _compare(
    block, row, target, background, top, left, bottom, right, weight, steep, half
):  # fmt: skip
    """Return the sum of the distances of a drawn tile, and prepare its block for gradients."""
    pixels, width, plane = target.reshape(-1), target.shape[2], target.shape[1] * target.shape[2]
    one, zero = simd.splat(float32(1)), simd.splat(float32(0))
    total, covered = zero, simd.first_lanes(right - left)
    for y in range(TILE):
        o, passed, rest = y * TILE, simd.load(block, y * TILE), zero
        colour = simd.load(block, _BLOCK + o)
        for channel in range(3):
            shade, slope = colour + passed * background[channel], zero
            if top + y < bottom:
                at = channel * plane + (top + y) * width + left
                wanted = load_target(pixels, at, right - left, row)
                apart, slope = distances(shade * covered - wanted, weight, steep, half)
                total = total + apart
            rest = rest + slope * shade
            colour = simd.load(block, (2 + channel) * _BLOCK + o)  # its place is taken next
            simd.store(block, (2 + channel) * _BLOCK + o, slope)
        simd.store(block, o, one)
        simd.store(block, _BLOCK + o, rest)
    return simd.reduce_sum(total)


@parallel
def blend_and_compare(
    records, entries, starts, busiest, columns, background, target, weight, steep, half,
    tile_weights, losses, sums,
):  # fmt: skip
    """Draw tiles, compare them with the target and take the gradients while they are at hand.

    What ``blend``, ``photometric.distance`` and ``blend_backward`` do one after another, without a
    picture in between.

    Args:
        target: (3, H, W) uint8.
        weight: of each distance in the loss.
        steep, half: see ``photometric.distances``.
        tile_weights: (tiles,) float32, further factors on the loss of each tile; those of weight 0
            are not drawn. (0,) stands for 1 everywhere.
        losses: (tiles,) out, sums of the distances, without the tiles' weights.
        others: see ``blend`` and ``blend_backward``.
    """
    height, width = target.shape[1], target.shape[2]
    for part in prange(PARTS):
        own = sums[part].reshape(-1)
        own[:] = float32(0)
        block, row = np.empty(5 * _BLOCK, np.float32), np.empty(TILE, np.float32)
        kept, ranges = np.empty(0, np.float32), np.empty((0, 2), np.int32)
        for turn in range(part, busiest.shape[0], PARTS):
            tile = busiest[turn]
            tile_weight = tile_weights[tile] if tile_weights.shape[0] > 0 else float32(1)
            if tile_weight == float32(0):
                losses[tile] = 0
                continue
            tile_y, tile_x, x0, y0 = _corner(tile, columns)
            top, left = tile_y * TILE, tile_x * TILE
            bottom, right = min(top + TILE, height), min(left + TILE, width)
            start, end = starts[tile], starts[tile + 1]
            if start == end:
                losses[tile] = _compare_plain(
                    row, target, background, top, left, bottom, right, steep, half
                )
                continue
            if (end - start) * _BLOCK > kept.shape[0]:
                kept = np.empty((end - start) * _BLOCK, np.float32)
                ranges = np.empty(((end - start + 15) >> 4, 2), np.int32)
            end = _draw_and_keep(block, kept, ranges, records, entries, start, end, x0, y0)
            losses[tile] = _compare(
                block, row, target, background, top, left, bottom, right, weight, steep, half
            )
            _differentiate_kept(
                block, kept, ranges, records, entries, start, end, x0, y0, tile_weight, own
            )


@parallel
def gather(sums, conics, opacities, d_means2d, d_conics, d_opacities, d_colours, on_screen):
    """Turn every splat's sums over the parts into the gradients of what was projected.

    ``on_screen`` gets what ``d_means2d`` would be if all tiles that are drawn had the weight 1.
    """
    for i in prange(conics.shape[0]):
        e, ex, ey = float32(0), float32(0), float32(0)
        exx, exy, eyy = float32(0), float32(0), float32(0)
        red, green, blue = float32(0), float32(0), float32(0)
        plain_ex, plain_ey = float32(0), float32(0)
        for part in range(PARTS):
            own = sums[part, i]
            plain_ex, plain_ey = plain_ex + own[WEIGHTED], plain_ey + own[WEIGHTED + 1]
            e, ex, ey = e + own[0], ex + own[1], ey + own[2]
            exx, exy, eyy = exx + own[3], exy + own[4], eyy + own[5]
            red, green, blue = red + own[6], green + own[7], blue + own[8]
        a, b, c = conics[i, 0], conics[i, 1], conics[i, 2]
        d_means2d[i, 0], d_means2d[i, 1] = a * ex + b * ey, b * ex + c * ey
        on_screen[i, 0] = a * plain_ex + b * plain_ey
        on_screen[i, 1] = b * plain_ex + c * plain_ey
        d_conics[i, 0], d_conics[i, 1], d_conics[i, 2] = -_HALF * exx, -exy, -_HALF * eyy
        d_opacities[i] = e / opacities[i] if opacities[i] > float32(0) else float32(0)
        d_colours[i, 0], d_colours[i, 1], d_colours[i, 2] = red, green, blue
