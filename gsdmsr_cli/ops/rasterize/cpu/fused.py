"""A whole look at stored splats in one call: draw them, compare, and take all gradients.

The kernels are those that draw and compare one by one; what is saved is everything between them.
"""

from __future__ import annotations

import numpy as np

from gsdmsr_cli.backends.cpu.jit import serial
from gsdmsr_cli.backends.cpu.simd import empty_aligned
from gsdmsr_cli.ground.splatting_constants import TILE
from gsdmsr_cli.ops.photometric.cpu import compare
from gsdmsr_cli.ops.rasterize.cpu.binning import assign, leave_out
from gsdmsr_cli.ops.rasterize.cpu.blending import (
    PARTS,
    RECORD,
    blend,
    blend_and_compare,
    blend_backward,
    gather,
    pack,
)
from gsdmsr_cli.ops.rasterize.cpu.harmonics import colour, colour_backward
from gsdmsr_cli.ops.rasterize.cpu.projection import project, project_backward


@serial
def look(
    means, quats, log_scales, logit_opacities, sh, axes, terms, view, intrinsics, centre,
    width, height, background, target, ssim_weight, bend, threads, tile_weights, errors,
    d_means, d_quats, d_log_scales, d_logit_opacities, d_sh, d_axes, on_screen,
):  # fmt: skip
    """Return the loss against ``target`` (3, H, W) uint8, and write its gradients.

    Arguments as in ``projection.project``, ``harmonics.colour``, ``blending.blend``,
    ``blending.blend_and_compare``, ``blending.gather`` and ``photometric.compare``; every ``d_``
    argument has the shape of what it is the gradient of. Tiles can only be weighted, and have an
    error each, if SSIM has no weight.
    """
    n = means.shape[0]
    means2d, conics = np.empty((n, 2), np.float32), np.empty((n, 3), np.float32)
    depths, opacities = np.empty(n, np.float32), np.empty(n, np.float32)
    radii, tiles = np.empty(n, np.float32), np.empty(n, np.int32)
    project(
        means, quats, log_scales, logit_opacities, sh, axes, view, intrinsics, width, height,
        means2d, conics, depths, opacities, radii, tiles,
    )  # fmt: skip
    if tile_weights.shape[0] > 0:
        leave_out(means2d, radii, width, height, tile_weights, opacities, tiles)
    colours = np.empty((n, 3), np.float32)
    colour(means, sh, terms, centre, opacities, colours)
    entries, starts, busiest, order = assign(
        means2d, conics, depths, opacities, tiles, width, height, threads
    )
    records = empty_aligned(n * RECORD).reshape(n, RECORD)
    pack(order, means2d, conics, opacities, colours, records)
    columns, rows = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    sums = empty_aligned(PARTS * n * RECORD).reshape(PARTS, n, RECORD)
    if ssim_weight > 0:
        rgb = np.empty((3, rows * TILE, columns * TILE), np.float32)
        alpha = np.empty((rows * TILE, columns * TILE), np.float32)
        ends = np.empty(rows * columns, np.int32)
        blend(records, entries, starts, busiest, threads, columns, background, rgb, alpha, ends)
        d_rgb, d_alpha = np.empty_like(rgb), np.empty((0, 0), np.float32)
        loss = compare(rgb, target, height, width, ssim_weight, bend, d_rgb)
        blend_backward(
            records, entries, starts, busiest, ends, columns, rgb, alpha, d_rgb, d_alpha, sums
        )
    else:
        count = 3 * height * width
        steep, half, unit = bend
        blend_and_compare(
            records, entries, starts, busiest, columns, background, target,
            np.float32(unit / count), np.float32(steep), np.float32(half), tile_weights, errors,
            sums,
        )  # fmt: skip
        errors *= unit
        if tile_weights.shape[0] > 0:
            loss = (errors * tile_weights).sum() / count
        else:
            loss = errors.sum() / count
    d_conics, d_colours = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32)
    d_depths, d_opacities = np.zeros(n, np.float32), np.empty(n, np.float32)
    d_means2d = np.empty((n, 2), np.float32)
    gather(sums, conics, opacities, d_means2d, d_conics, d_opacities, d_colours, on_screen)
    project_backward(
        means, quats, log_scales, axes, view, intrinsics, width, height, conics, opacities,
        d_means2d, d_conics, d_depths, d_opacities,
        d_means, d_quats, d_log_scales, d_logit_opacities, d_axes,
    )  # fmt: skip
    colour_backward(means, sh, terms, centre, opacities, colours, d_colours, d_means, d_sh)
    return loss
