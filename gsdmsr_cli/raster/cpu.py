"""The CPU engine: Numba kernels behind one autograd function per stage, project and blend."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.backends.cpu.jit import threads
from gsdmsr_cli.backends.tensors import array
from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.measure import Measure
from gsdmsr_cli.ground.splatting_constants import TILE, tile_grid
from gsdmsr_cli.ops.rasterize.cpu import binning, blending, harmonics, projection
from gsdmsr_cli.ops.rasterize.cpu import fused as looking
from gsdmsr_cli.raster import Comparison
from gsdmsr_cli.raster._stored import in_groups, refuse_features, stored_of
from gsdmsr_cli.scene.camera import Camera


def unavailable(device: str) -> str | None:
    """Return why the engine cannot draw on ``device``, or None if it can."""
    return None if device == "cpu" else "it draws tensors that lie in the memory of the CPU"


def rasterize(
    moment: Moment,
    camera: Camera,
    background: Tensor,
    sh_degree: int | None = None,
    with_depth: bool = False,
) -> Frame:
    """Draw a float32 moment; see ``gsdmsr_cli.raster``."""
    degree = moment.splats.degree_up_to(sh_degree)
    means2d, conics, depths, opacities, colours, radii, tiles = _Project.apply(
        camera, degree, *stored_of(moment)
    )
    bins = binning.bin_splats(
        array(means2d), array(conics), array(depths), array(opacities), array(tiles),
        camera.width, camera.height,
    )  # fmt: skip
    screen = means2d, conics, opacities
    size = camera.width, camera.height
    rgb, alpha = _Blend.apply(bins, size, *screen, colours, background)
    depth = None
    if with_depth:
        as_colour = depths[:, None].expand(-1, 3)
        depth = _Blend.apply(bins, size, *screen, as_colour, torch.zeros(3))[0][..., 0]
    features = None
    if moment.features is not None:
        features = _blend_features(bins, size, screen, moment.features)
    return Frame(rgb, alpha, depth, radii, means2d, features)


def _blend_features(
    bins: binning.Bins, size: tuple[int, int], screen: tuple[Tensor, ...], features: Tensor
) -> Tensor:
    """Return the (H, W, F) features, blended three at a time as if they were colours."""
    planes = [
        _Blend.apply(bins, size, *screen, group, torch.zeros(3))[0].permute(2, 0, 1)
        for group in in_groups(features, 3)
    ]
    return torch.cat(planes)[: features.shape[1]].permute(1, 2, 0)


def compare(
    moment: Moment,
    camera: Camera,
    background: Tensor,
    target: Tensor,
    measure: Measure,
    sh_degree: int | None = None,
    tile_weights: Tensor | None = None,
) -> Comparison:
    """Draw a float32 moment and compare, in one call; see ``gsdmsr_cli.raster``."""
    refuse_features(moment)
    if tile_weights is not None and measure.ssim > 0:
        raise ValueError("tiles cannot be weighted where SSIM counts, whose windows overlap them")
    degree = moment.splats.degree_up_to(sh_degree)
    weights = torch.empty(0) if tile_weights is None else tile_weights.contiguous()
    loss, on_screen, errors = _Look.apply(
        camera, degree, background, target, measure, weights, *stored_of(moment)
    )
    return Comparison(loss, on_screen, errors if measure.ssim == 0 else None)


def _view(camera: Camera) -> tuple[NDArray[np.float32], NDArray[np.float32], int, int]:
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
    return camera.world_to_camera[:3].astype(np.float32), intrinsics, camera.width, camera.height


def _arrays(tensors: Sequence[Tensor | None]) -> tuple[Any, ...]:
    """Return what ``stored_of`` does, or its gradients, as kernels take them.

    What is not read is empty, but axes stay None: that chooses the kernel.
    """
    *five, axes = tensors
    unread = np.empty((0, 0), np.float32)
    return *(unread if t is None else array(t) for t in five), None if axes is None else array(axes)


class _Look(Function):
    """Stored splats to a loss; its gradients are taken at once, and only passed on later."""

    @staticmethod
    def forward(
        ctx: Any,
        camera: Camera,
        degree: int,
        background: Tensor,
        target: Tensor,
        measure: Measure,
        tile_weights: Tensor,
        means: Tensor,
        *others: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        stored = means, *others
        gradients = [None if tensor is None else torch.empty_like(tensor) for tensor in stored]
        on_screen = torch.empty(len(means), 2)
        rows, columns = tile_grid(camera.width, camera.height)
        errors = torch.empty(rows * columns, dtype=torch.float64)
        view, intrinsics, width, height = _view(camera)
        loss = looking.look(
            *_arrays(stored), (degree + 1) ** 2, view, intrinsics,
            camera.centre.astype(np.float32), width, height, array(background.contiguous()),
            array(target), float(measure.ssim), measure.bend(), threads(),
            array(tile_weights), array(errors), *_arrays(gradients), array(on_screen),
        )  # fmt: skip
        ctx.gradients = gradients
        ctx.mark_non_differentiable(on_screen, errors)
        return torch.tensor(loss, dtype=torch.float32), on_screen, errors

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_loss: Tensor, *_: Any) -> tuple[Tensor | None, ...]:
        scale = float(d_loss)
        passed = (g if g is None or scale == 1.0 else g * scale for g in ctx.gradients)
        return None, None, None, None, None, None, *passed


class _Project(Function):
    """Stored splats to screen positions, conics, depths, opacities and colours."""

    @staticmethod
    def forward(
        ctx: Any,
        camera: Camera,
        degree: int,
        means: Tensor,
        quats: Tensor | None,
        log_scales: Tensor | None,
        logit_opacities: Tensor,
        sh: Tensor,
        axes: Tensor | None,
    ) -> tuple[Tensor, ...]:
        n = len(means)
        means2d, conics, colours = (torch.empty(n, k) for k in (2, 3, 3))
        depths, opacities, radii = (torch.empty(n) for _ in range(3))
        tiles = torch.empty(n, dtype=torch.int32)
        stored = _arrays((means, quats, log_scales, logit_opacities, sh, axes))
        projected = [array(t) for t in (means2d, conics, depths, opacities, radii, tiles)]
        projection.project(*stored, *_view(camera), *projected)
        count, centre = (degree + 1) ** 2, camera.centre.astype(np.float32)
        harmonics.colour(array(means), array(sh), count, centre, array(opacities), array(colours))
        ctx.camera, ctx.count, ctx.centre = camera, count, centre
        ctx.save_for_backward(
            means, quats, log_scales, logit_opacities, sh, axes, conics, opacities, colours
        )
        ctx.mark_non_differentiable(radii, tiles)
        ctx.set_materialize_grads(True)
        return means2d, conics, depths, opacities, colours, radii, tiles

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(
        ctx: Any,
        d_means2d: Tensor,
        d_conics: Tensor,
        d_depths: Tensor,
        d_opacities: Tensor,
        d_colours: Tensor,
        *_: Any,
    ) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        means, quats, log_scales, _logits, sh, axes = _arrays(saved[:6])
        conics, opacities, colours = map(array, saved[6:])
        gradients = [None if t is None else torch.empty_like(t) for t in saved[:6]]
        d_means, d_quats, d_log_scales, d_logit_opacities, d_sh, d_axes = _arrays(gradients)
        incoming = [
            array(d.contiguous()) for d in (d_means2d, d_conics, d_depths, d_opacities, d_colours)
        ]
        projection.project_backward(
            means, quats, log_scales, axes, *_view(ctx.camera), conics, opacities, *incoming[:4],
            d_means, d_quats, d_log_scales, d_logit_opacities, d_axes,
        )  # fmt: skip
        harmonics.colour_backward(
            means, sh, ctx.count, ctx.centre, opacities, colours, incoming[4], d_means, d_sh
        )
        return None, None, *gradients


class _Blend(Function):
    """Binned splats to a picture; gradients for all but the bins and the background."""

    @staticmethod
    def forward(
        ctx: Any,
        bins: binning.Bins,
        size: tuple[int, int],
        means2d: Tensor,
        conics: Tensor,
        opacities: Tensor,
        colours: Tensor,
        background: Tensor,
    ) -> tuple[Tensor, Tensor]:
        width, height = size
        rows, columns = tile_grid(width, height)
        records = array(torch.empty(len(means2d), blending.RECORD))  # torch's begin cache lines
        screen = [array(t) for t in (means2d, conics, opacities)]
        blending.pack(bins.splats, *screen, array(colours.contiguous()), records)
        rgb = torch.empty(3, rows * TILE, columns * TILE)
        alpha = torch.empty(rows * TILE, columns * TILE)
        ends = np.empty(rows * columns, np.int32)
        blending.blend(
            records, bins.entries, bins.starts, bins.busiest, threads(), columns,
            array(background.contiguous()), array(rgb), array(alpha), ends,
        )  # fmt: skip
        ctx.bins, ctx.records, ctx.ends, ctx.columns = bins, records, ends, columns
        ctx.padded = rgb, alpha
        ctx.save_for_backward(conics, opacities)
        ctx.set_materialize_grads(False)
        return cropped(rgb, height, width), alpha[:height, :width]

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_rgb: Tensor | None, d_alpha: Tensor | None) -> tuple[Any, ...]:
        conics, opacities = ctx.saved_tensors
        bins, (rgb, alpha) = ctx.bins, ctx.padded
        n = len(conics)
        sums = array(torch.empty(blending.PARTS, n, blending.RECORD))
        d_rgb = torch.zeros_like(rgb) if d_rgb is None else padded(d_rgb, rgb.shape)
        if d_alpha is None:
            d_alpha = torch.empty(0, 0)
        else:
            d_alpha = padded(d_alpha[..., None], (1, *alpha.shape))[0]
        blending.blend_backward(
            ctx.records, bins.entries, bins.starts, bins.busiest, ctx.ends, ctx.columns,
            array(rgb), array(alpha), array(d_rgb), array(d_alpha), sums,
        )  # fmt: skip
        d_means2d, d_conics, d_colours = (torch.empty(n, k) for k in (2, 3, 3))
        d_opacities = torch.empty(n)
        blending.gather(
            sums, array(conics), array(opacities), array(d_means2d), array(d_conics),
            array(d_opacities), array(d_colours), np.empty((n, 2), np.float32),
        )  # fmt: skip
        return None, None, d_means2d, d_conics, d_opacities, d_colours, None


def cropped(planes: Tensor, height: int, width: int) -> Tensor:
    """Return planes (C, H', W') as a picture (H, W, C), a view of the same memory."""
    return planes[:, :height, :width].permute(1, 2, 0)


def padded(picture: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Return a picture (H, W, C) as planes (C, H', W'), 0 outside, without a copy where possible.

    A picture that is itself a full view of such planes (see ``cropped``) is returned as they are.
    """
    planes = picture.permute(2, 0, 1)
    if tuple(planes.shape) == tuple(shape):
        return planes.contiguous()
    result = torch.zeros(shape)
    result[:, : planes.shape[1], : planes.shape[2]] = planes
    return result
