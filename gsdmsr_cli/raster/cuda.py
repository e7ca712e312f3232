"""The CUDA engine: kernels compiled at run time, behind autograd functions per group of stages."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.backends.cuda.availability import missing
from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.measure import Measure
from gsdmsr_cli.ops.rasterize.cuda import stages
from gsdmsr_cli.raster import Comparison
from gsdmsr_cli.raster._check import disagreement
from gsdmsr_cli.raster._check_operations import operations_disagreement
from gsdmsr_cli.raster._stored import in_groups, refuse_features, stored_of
from gsdmsr_cli.scene.camera import Camera


def unavailable(device: str) -> str | None:
    """Return why the engine cannot draw on ``device``, or None if it can.

    What is not missing is tried out once, so that nobody relies on a GPU that draws otherwise.
    """
    if device == "cpu":
        return "it draws tensors that lie in the memory of a GPU"
    return missing() or _disagreement()


@cache
def _disagreement() -> str | None:
    return disagreement(rasterize, compare, "cuda") or operations_disagreement("cuda")


def rasterize(
    moment: Moment,
    camera: Camera,
    background: Tensor,
    sh_degree: int | None = None,
    with_depth: bool = False,
) -> Frame:
    """Draw a float32 moment; see ``gsdmsr_cli.raster``.

    Where gradients are wanted nothing waits for the GPU; see ``cuda.room`` for what that may cost.
    """
    views, read = stages.views_of([camera]), moment.tensors().values()
    exact = not (torch.is_grad_enabled() and any(t.requires_grad for t in read))
    means2d, shapes, paints, radii, keys, counts = _Project.apply(
        views, _terms(moment.splats, sh_degree), *stored_of(moment)
    )
    projected = stages.Projected(means2d, shapes, paints, radii, keys, counts)
    bins = stages.bin_splats(views, projected, exact)
    rgb, alpha, *depth = _Blend.apply(
        views, bins, _to(background, means2d), with_depth, means2d, shapes, paints
    )
    features = None
    if moment.features is not None:
        features = _blend_features(views, bins, means2d, shapes, moment.features)
    return Frame(
        rgb=rgb[0].permute(1, 2, 0),
        alpha=alpha[0],
        depth=depth[0][0] if depth else None,
        radii=radii,
        means2d=means2d,
        features=features,
    )


def _blend_features(
    views: stages.Views, bins: stages.Bins, means2d: Tensor, shapes: Tensor, features: Tensor
) -> Tensor:
    """Return the (H, W, F) features, blended four at a time as if they were colour and depth."""
    planes = []
    for group in in_groups(features, 4):
        paints, nothing = group.contiguous(), group.new_zeros(3)
        first, _, last = _Blend.apply(views, bins, nothing, True, means2d, shapes, paints)
        planes += [first[0], last]
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
    """Draw a float32 moment and compare, without waiting for the GPU; see ``gsdmsr_cli.raster``."""
    weights = None if tile_weights is None else [tile_weights]
    given = [moment], [camera], background, [target], measure, sh_degree, weights
    loss, (view,) = compare_views(*given)
    return view._replace(loss=loss)


def compare_views(
    moments: Sequence[Moment],
    cameras: Sequence[Camera],
    background: Tensor,
    targets: Sequence[Tensor],
    measure: Measure,
    sh_degree: int | None = None,
    tile_weights: Sequence[Tensor] | None = None,
) -> tuple[Tensor, list[Comparison]]:
    """Draw and compare several views at once, each as ``compare`` does.

    Args:
        moments: of each view, such as one model's at several times; what is the very same tensor
            in all of them is read in place, what differs is copied. All have axes or none has.
        cameras: of each view, all of one picture size.
        background, measure, sh_degree: of all views.
        targets, tile_weights: of each view.

    Returns:
        the sum of the losses, which gradients come from, and what is to be said of each view, with
        losses that have none.

    Raises:
        ValueError: there are no views, more than ``MOST_VIEWS``, or they differ in size; some but
            not all moments have axes; or one has features.
    """
    if tile_weights is not None and measure.ssim > 0:
        raise ValueError("tiles cannot be weighted where SSIM counts, whose windows overlap them")
    for moment in moments:
        refuse_features(moment)
    views = stages.views_of(cameras)
    stored = [_together(part) for part in zip(*map(stored_of, moments), strict=True)]
    first = moments[0].splats
    loss, losses, on_screen, errors = _Look.apply(
        views, _terms(first, sh_degree), _to(background, first.means),
        targets, measure, None if tile_weights is None else torch.cat([*tile_weights]), *stored,
    )  # fmt: skip
    each = zip(losses, on_screen.view(len(moments), -1, 2), errors, strict=True)
    return loss, [Comparison(*view[:2], None if measure.ssim > 0 else view[2]) for view in each]


def _together(tensors: Sequence[Tensor | None]) -> Tensor | None:
    """Return the one tensor that all views share, or all of them stacked."""
    there = [tensor for tensor in tensors if tensor is not None]
    if not there:
        return None
    if len(there) < len(tensors):
        raise ValueError("moments with axes and without cannot be drawn at once")
    shared = all(tensor is there[0] for tensor in there)
    return there[0] if shared else torch.stack(there)


def _terms(splats: Splats, sh_degree: int | None) -> int:
    """Return how many coefficients of colour are used."""
    return (splats.degree_up_to(sh_degree) + 1) ** 2


def _to(background: Tensor, like: Tensor) -> Tensor:
    return background.detach().to(like).contiguous()


class _Project(Function):
    """Stored splats to screen positions, shapes and paints."""

    @staticmethod
    def forward(ctx: Any, views: stages.Views, terms: int, *tensors: Any) -> tuple[Tensor, ...]:
        stored = stages.Stored(*tensors)
        projected = stages.project(views, stored, terms)
        ctx.views, ctx.terms = views, terms
        ctx.save_for_backward(*stored, projected.shapes, projected.paints, projected.radii)
        ctx.mark_non_differentiable(projected.radii, projected.keys, projected.counts)
        ctx.set_materialize_grads(True)
        return tuple(projected)

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(
        ctx: Any, d_means2d: Tensor, d_shapes: Tensor, d_paints: Tensor, *_: Any
    ) -> tuple[Tensor | None, ...]:
        *tensors, shapes, paints, radii = ctx.saved_tensors
        given = d_means2d.contiguous(), d_shapes.contiguous(), d_paints.contiguous()
        gradients = stages.project_backward(
            ctx.views, stages.Stored(*tensors), ctx.terms, (shapes, paints, radii), given
        )
        return None, None, *gradients


class _Blend(Function):
    """Binned splats to pictures; gradients for all but the bins and the background."""

    @staticmethod
    def forward(
        ctx: Any,
        views: stages.Views,
        bins: stages.Bins,
        background: Tensor,
        with_depth: bool,
        *projected: Tensor,
    ) -> tuple[Tensor, ...]:
        means2d, shapes, paints = projected
        drawn = stages.blend(views, (means2d, shapes, paints), bins, background, with_depth)
        there = tuple(picture for picture in drawn if picture is not None)
        ctx.views, ctx.bins = views, bins
        ctx.save_for_backward(*projected, *there)
        ctx.set_materialize_grads(False)
        return there

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(
        ctx: Any, d_rgb: Tensor | None, d_alpha: Tensor | None, d_depth: Tensor | None = None
    ) -> tuple[Tensor | None, ...]:
        means2d, shapes, paints, rgb, alpha, *depth = ctx.saved_tensors
        given = [None if d is None else d.contiguous() for d in (d_rgb, d_alpha, d_depth)]
        d_rgb = torch.zeros_like(rgb) if given[0] is None else given[0]
        sums = stages.blend_backward(
            ctx.views, (means2d, shapes, paints), ctx.bins,
            (rgb, alpha, depth[0] if depth else None), (d_rgb, given[1], given[2]),
        )  # fmt: skip
        return None, None, None, None, *stages.gather(shapes, sums, weighted=False)[0]


class _Look(Function):
    """Stored splats to losses; their gradients are taken at once, and only passed on later."""

    @staticmethod
    def forward(
        ctx: Any,
        views: stages.Views,
        terms: int,
        background: Tensor,
        targets: Sequence[Tensor],
        measure: Measure,
        tile_weights: Tensor | None,
        *tensors: Any,
    ) -> tuple[Tensor, ...]:
        stored = stages.Stored(*tensors)
        found = stages.project(views, stored, terms)
        bins = stages.bin_splats(views, found, exact=False)
        projected = found.means2d, found.shapes, found.paints
        if measure.ssim > 0:
            drawn = stages.blend(views, projected, bins, background, with_depth=False)
            losses, d_rgb = stages.compare(views, drawn[0], targets, measure)
            sums = stages.blend_backward(views, projected, bins, drawn, (d_rgb, None, None))
            errors = losses.new_empty(views.number, 0)
        else:
            errors, sums = stages.blend_and_compare(
                views, projected, bins, background, targets, tile_weights, measure
            )
            weighted = errors if tile_weights is None else errors * tile_weights.view_as(errors)
            losses = weighted.sum(dim=1) / (3 * views.width * views.height)
        given, on_screen = stages.gather(found.shapes, sums, tile_weights is not None)
        ctx.gradients = stages.project_backward(
            views, stored, terms, (found.shapes, found.paints, found.radii), given
        )
        ctx.mark_non_differentiable(losses, on_screen, errors)
        return losses.sum().float(), losses, on_screen, errors

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, d_loss: Tensor, *_: Any) -> tuple[Tensor | None, ...]:
        # always multiplied: whether the slope is 1 would have to be waited for
        there = [gradient for gradient in ctx.gradients if gradient is not None]
        scaled = iter(torch._foreach_mul(there, d_loss))
        passed = (None if gradient is None else next(scaled) for gradient in ctx.gradients)
        return None, None, None, None, None, None, *passed
