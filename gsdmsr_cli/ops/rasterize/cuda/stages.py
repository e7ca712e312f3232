"""The stages of drawing on tensors: projection, binning, blending, comparing; and their gradients.

V views of N splats each are handled in one launch per stage. A stored tensor is (N, ...), shared by
all views, or (V, N, ...) with rows of its own for each. What is projected has a row for each view
and splat, V * N in all, view by view.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsdmsr_cli.backends.cuda import recording
from gsdmsr_cli.backends.cuda.compiler import MOST_VIEWS
from gsdmsr_cli.backends.cuda.launch import blocks, launch, struct
from gsdmsr_cli.ground.measure import Measure
from gsdmsr_cli.ground.splatting_constants import TILE, tile_grid
from gsdmsr_cli.ops.rasterize.cuda.room import Room
from gsdmsr_cli.scene.camera import Camera

SUMS = 16
"""Floats for the sums of a splat, as in blending.cu."""

_PIXELS = TILE * TILE
_DIMENSIONS = {"means": 2, "quats": 2, "log_scales": 2, "logit_opacities": 1, "sh": 3, "axes": 3}
"""Of each stored tensor, when all views share it."""

Seen = tuple[Tensor, Tensor, Tensor]
"""What blending reads of projected splats: means2d, shapes and paints, see ``Projected``."""

_room = Room()


class _View(ctypes.Structure):
    _fields_ = (
        ("rotation", ctypes.c_float * 9),
        ("translation", ctypes.c_float * 3),
        ("intrinsics", ctypes.c_float * 4),
        ("centre", ctypes.c_float * 3),
    )


class _Views(ctypes.Structure):
    _fields_ = (("view", _View * MOST_VIEWS),)


class _Targets(ctypes.Structure):
    _fields_ = (("of_view", ctypes.c_void_p * MOST_VIEWS),)


class Views(NamedTuple):
    """Cameras of one picture size, as kernels take them.

    Attributes:
        packed: their numbers.
        number: how many there are.
        width, height: of every picture [px].
    """

    packed: ctypes.Structure
    number: int
    width: int
    height: int

    @property
    def tiles(self) -> int:
        """Number of tiles of a picture."""
        return math.prod(tile_grid(self.width, self.height))


class Stored(NamedTuple):
    """N splats as they are stored, float32; each for all views or with rows for each view.

    Either axes are None, or quats and log_scales are; gradients are None where these are.

    Attributes:
        means, quats, log_scales, logit_opacities, sh: see ``Splats``.
        axes: see ``Moment``.
    """

    means: Tensor
    quats: Tensor | None
    log_scales: Tensor | None
    logit_opacities: Tensor
    sh: Tensor
    axes: Tensor | None

    @property
    def rows(self) -> int:
        """N."""
        return int(self.means.shape[-2])

    @property
    def form(self) -> str:
        """What the names of kernels begin with that read these tensors."""
        return "project" if self.axes is None else "project_axes"

    @property
    def own(self) -> ctypes.Structure:
        """Which tensors have rows for each view."""
        pairs = zip(self, _DIMENSIONS.values(), strict=True)
        return struct(*(int(tensor is not None and tensor.dim() > d) for tensor, d in pairs))


class Projected(NamedTuple):
    """V * N splats on the screen.

    Attributes:
        means2d: (V N, 2) [px].
        shapes: (V N, 4), A, B, C, L of alpha = 2^(L + A x^2 + B x y + C y^2).
        paints: (V N, 4), red, green, blue and camera z.
        radii: (V N,) half extent [px], 0 where the splat is not drawn.
        keys: (V N,) int32, sort like depths.
        counts: (V N,) int32, numbers of tiles.
    """

    means2d: Tensor
    shapes: Tensor
    paints: Tensor
    radii: Tensor
    keys: Tensor
    counts: Tensor


class Bins(NamedTuple):
    """Which splats touch which tile.

    Attributes:
        starts: (V tiles + 1,) int32, where each tile's entries start.
        entries: (room, 2) int32 in tile order, front to back: row, and a bit for each block of
            8 x 4 pixels of the tile that it touches.
    """

    starts: Tensor
    entries: Tensor


def views_of(cameras: Sequence[Camera]) -> Views:
    """Pack cameras.

    Raises:
        ValueError: they are none, too many, or differ in the size of their pictures.
    """
    sizes = {(camera.width, camera.height) for camera in cameras}
    if not 1 <= len(cameras) <= MOST_VIEWS or len(sizes) != 1:
        raise ValueError(
            f"{len(cameras)} cameras of picture sizes {sorted(sizes)} cannot be drawn at once; "
            f"allowed: 1 to {MOST_VIEWS} of one size"
        )
    packed = _Views()
    _fill_views(packed, cameras)
    recording.vary(packed, lambda packed, inputs: _fill_views(packed, inputs.cameras))
    return Views(packed, len(cameras), *sizes.pop())


def _fill_views(packed: _Views, cameras: Sequence[Camera]) -> None:
    for view, camera in zip(packed.view, cameras, strict=False):
        view.rotation[:] = camera.rotation.flatten().tolist()
        view.translation[:] = camera.translation.tolist()
        view.intrinsics[:] = [camera.fx, camera.fy, camera.cx, camera.cy]
        view.centre[:] = camera.centre.tolist()


def project(views: Views, stored: Stored, terms: int) -> Projected:
    """Project splats and find their colours.

    Args:
        views: where to.
        stored: the splats.
        terms: coefficients of colour that are used.
    """
    n, like = stored.rows, stored.means
    rows = views.number * n
    means2d, shapes, paints = (like.new_empty(rows, width) for width in (2, 4, 4))
    radii = like.new_empty(rows)
    keys, counts = (like.new_empty(rows, dtype=torch.int32) for _ in range(2))
    launch(
        "projection", stored.form, (blocks(n, 256), views.number), 256,
        views.packed, n, struct(*stored), stored.own, int(stored.sh.shape[-2]), terms,
        views.width, views.height, means2d, shapes, paints, radii, keys, counts,
    )  # fmt: skip
    return Projected(means2d, shapes, paints, radii, keys, counts)


def project_backward(
    views: Views,
    stored: Stored,
    terms: int,
    projected: tuple[Tensor, Tensor, Tensor],
    given: Seen,
) -> Stored:
    """Return the gradients of the stored tensors; views add up where they share one.

    Args:
        views, stored, terms: as in ``project``.
        projected: shapes, paints and radii.
        given: gradients of means2d, shapes and paints.
    """
    shapes, paints, radii = projected
    empty: list[Any] = [None if tensor is None else torch.empty_like(tensor) for tensor in stored]
    gradients = Stored(*empty)._replace(sh=torch.zeros_like(stored.sh))
    n = stored.rows
    launch(
        "projection", f"{stored.form}_backward", (blocks(n, 128), 1), 128,
        views.packed, views.number, n, struct(*stored), stored.own, int(stored.sh.shape[-2]),
        terms, views.width, views.height, radii, shapes, paints, *given, struct(*gradients),
    )  # fmt: skip
    return gradients


def bin_splats(views: Views, projected: Projected, exact: bool) -> Bins:
    """List the splats of every tile, front to back.

    Args:
        views, projected: as ``project`` was given and has returned.
        exact: wait for the number of entries, so that all have room; else it is guessed from the
            pictures before and nothing is waited for, see ``Room``.
    """
    rows, tiles = len(projected.keys), views.number * views.tiles
    like = projected.counts
    if rows == 0:
        return Bins(like.new_zeros(tiles + 1), like.new_empty(0, 2))
    order = projected.keys.sort(stable=True).indices
    ends = projected.counts[order].cumsum(0)
    room = _room.find(ends[-1], (views.number, views.width, views.height), rows, exact)
    narrow = tiles < 1 << 15
    kind = torch.int16 if narrow else torch.int32
    unsorted = like.new_full((room,), tiles, dtype=kind)
    listed, entries = (like.new_empty(room, 2) for _ in range(2))
    launch(
        "binning", "emit_short" if narrow else "emit_int", (blocks(rows, 256), 1), 256,
        rows, rows // views.number, views.width, views.height, order, ends, projected.counts,
        projected.means2d, projected.shapes, room, unsorted, listed,
    )  # fmt: skip
    by_tile = unsorted.sort(stable=True)
    starts = like.new_empty(tiles + 1)
    launch(
        "binning", "arrange_short" if narrow else "arrange_int", (blocks(room, 256), 1), 256,
        room, tiles, by_tile.values, by_tile.indices, listed, entries, starts,
    )  # fmt: skip
    return Bins(starts, entries)


def _drawn(projected: Seen, bins: Bins) -> ctypes.Structure:
    return struct(*projected, *bins)


def blend(
    views: Views,
    projected: Seen,
    bins: Bins,
    background: Tensor,
    with_depth: bool,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Return rgb (V, 3, H, W), alpha (V, H, W) and, if asked for, depth (V, H, W).

    Args:
        views, bins: as before.
        projected: means2d, shapes and paints.
        background: (3,).
        with_depth: whether to blend camera z.
    """
    size = views.height, views.width
    rgb = background.new_empty(views.number, 3, *size)
    alpha = background.new_empty(views.number, *size)
    depth = torch.empty_like(alpha) if with_depth else None
    further = () if depth is None else (depth,)
    launch(
        "blending", "blend_with_depth" if with_depth else "blend",
        (views.number * views.tiles, 1), _PIXELS,
        views.width, views.height, _drawn(projected, bins), background, rgb, alpha, *further,
    )  # fmt: skip
    return rgb, alpha, depth


def blend_backward(
    views: Views,
    projected: Seen,
    bins: Bins,
    drawn: tuple[Tensor, Tensor, Tensor | None],
    given: tuple[Tensor, Tensor | None, Tensor | None],
) -> Tensor:
    """Return each splat's sums over its pixels, (V N, 16), see ``gather``.

    Args:
        views, projected, bins: as in ``blend``.
        drawn: what that has returned.
        given: gradients of it; None stands for 0.
    """
    rgb, alpha, depth = drawn
    d_rgb, d_alpha, d_depth = given
    sums = rgb.new_zeros(len(projected[0]), SUMS)
    # with no slope of depth, the depth need not be gone through
    deep = depth is not None and d_depth is not None
    pictures = (
        (rgb, alpha, depth, d_rgb, d_alpha, d_depth) if deep else (rgb, alpha, d_rgb, d_alpha)
    )
    launch(
        "blending", "blend_with_depth_backward" if deep else "blend_backward",
        (views.number * views.tiles, 1), _PIXELS,
        views.width, views.height, _drawn(projected, bins), *pictures, sums,
    )  # fmt: skip
    return sums


def blend_and_compare(
    views: Views,
    projected: Seen,
    bins: Bins,
    background: Tensor,
    targets: Sequence[Tensor],
    tile_weights: Tensor | None,
    measure: Measure,
) -> tuple[Tensor, Tensor]:
    """Draw, compare by the mean distance of colours and differentiate, tile by tile.

    Args:
        views, projected, bins, background: as in ``blend``.
        targets: (3, H, W) uint8 of each view.
        tile_weights: (V tiles,) factors on the share of each tile in the loss; those of weight 0
            are not drawn. None for 1 everywhere.
        measure: how colours are compared.

    Returns:
        (V, tiles) float64, sums of the distances without these weights; and sums as
        ``blend_backward`` does.
    """
    errors = background.new_empty(views.number, views.tiles, dtype=torch.float64)
    sums = background.new_zeros(len(projected[0]), SUMS)
    steep, half, unit = measure.bend()
    launch(
        "blending", "blend_and_compare", (views.number * views.tiles, 1), _PIXELS,
        views.width, views.height, _drawn(projected, bins), background, _targets(views, targets),
        unit / (3 * views.width * views.height), steep, half, tile_weights, errors, sums,
    )  # fmt: skip
    return errors if unit == 1 else errors.mul_(unit), sums


def gather(shapes: Tensor, sums: Tensor, weighted: bool) -> tuple[Seen, Tensor]:
    """Return the gradients of means2d, shapes and paints, and those of means2d without weights.

    Args:
        shapes: (V N, 4).
        sums: (V N, 16) of ``blend_backward`` or ``blend_and_compare``.
        weighted: whether tiles had weights, so that the last result differs from the first.
    """
    rows = len(shapes)
    d_means2d, d_shapes, d_paints = (shapes.new_empty(rows, width) for width in (2, 4, 4))
    on_screen = torch.empty_like(d_means2d) if weighted else None
    launch(
        "blending", "gather", (blocks(rows, 256), 1), 256,
        rows, shapes, sums, d_means2d, d_shapes, d_paints, on_screen,
    )  # fmt: skip
    return (d_means2d, d_shapes, d_paints), d_means2d if on_screen is None else on_screen


def compare(
    views: Views, rgb: Tensor, targets: Sequence[Tensor], measure: Measure
) -> tuple[Tensor, Tensor]:
    """Return the loss of each view, (V,) float64, and the gradient by rgb.

    Args:
        views: as before.
        rgb: (V, 3, H, W).
        targets: (3, H, W) uint8 of each view.
        measure: what it is made of.
    """
    grid = views.tiles, 3 * views.number
    given = views.width, views.height, rgb, _targets(views, targets)
    maps, gradient = rgb.new_empty(3, *rgb.shape), torch.empty_like(rgb)
    similar, distant = (rgb.new_empty(views.number, grid[0] * 3) for _ in range(2))
    launch("photometric", "ssim_maps", grid, _PIXELS, *given, maps, similar)
    count = 3 * views.width * views.height
    steep, half, unit = measure.bend()
    colours = (1 - measure.ssim) * unit
    launch(
        "photometric", "photometric_gradient", grid, _PIXELS,
        *given, maps, colours / count, steep, half, -measure.ssim / count, gradient, distant,
    )  # fmt: skip
    ssim, distance = (part.double().sum(dim=1) / count for part in (similar, distant))
    return colours * distance + measure.ssim * (1 - ssim), gradient


def _targets(views: Views, targets: Sequence[Tensor]) -> ctypes.Structure:
    shape = 3, views.height, views.width

    def fill(packed: _Targets, targets: Sequence[Tensor]) -> None:
        for i, target in enumerate(targets):
            if target.shape != shape or target.dtype != torch.uint8 or not target.is_contiguous():
                raise ValueError(
                    f"a target is {tuple(target.shape)} {target.dtype}, not {shape} uint8"
                )
            packed.of_view[i] = target.data_ptr()

    packed = _Targets()
    fill(packed, targets)
    return recording.vary(packed, lambda packed, inputs: fill(packed, inputs.targets))
