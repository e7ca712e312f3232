"""Draws a model, compares the picture with a target, and takes the gradients."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.measure import Measure
from gsdmsr_cli.ground.ssim import REACH
from gsdmsr_cli.model.layer import Instant
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.ops.photometric import photometric_loss, tile_errors
from gsdmsr_cli.raster import Comparing, ComparingViews, Engine
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.training.gradients.inliers import inliers
from gsdmsr_cli.training.gradients.phase import ViewGradients


class Moving(NamedTuple):
    """Pixels of a view that count more than others.

    Attributes:
        mask: (H, W) bool, those that move.
        weight: by how much more they count.
    """

    mask: Tensor
    weight: float


def gradients_of(loss: Tensor, model: Model) -> Sequence[Tensor | None]:
    """Return the gradients of a loss by all trained tensors of a model."""
    return torch.autograd.grad(loss, list(model.trained().values()), allow_unused=True)


def sum_of(parts: Sequence[Tensor | None]) -> Tensor | None:
    """Return the sum of the parts that are there, in this order, or None."""
    total: Tensor | None = None
    for part in parts:
        if part is not None:
            total = part if total is None else total + part
    return total


def compare(
    engine: Engine,
    model: Model,
    moment: Moment,
    instant: Instant,
    camera: Camera,
    background: Tensor,
    target: Tensor,
    measure: Measure,
    sh_degree: int | None = None,
    tile_weights: Tensor | None = None,
    counted: Tensor | None = None,
    normal: float = 1.0,
    screens: bool = True,
    further: Tensor | None = None,
    moving: Moving | None = None,
) -> ViewGradients:
    """Draw what a model is at a moment, let it shade the frame, and compare that with a target.

    In one fused call, if the engine can and all that is compared is what it draws.

    Args:
        engine: what draws.
        model: whose trained tensors the gradients are taken by.
        moment: the model's, at the instant of the target or unmoved.
        instant: of the target.
        camera, background, sh_degree: see ``Engine.rasterize``.
        target, measure: see ``photometric_loss``.
        tile_weights: (tiles,) factors on the share of each tile in the loss, or None for 1
            everywhere; only where SSIM has no weight.
        counted: (H, W) bool, pixels that have a part in the loss, or None for all.
        normal: share of the pixels whose errors are taken to be normal, see ``inliers``.
        screens: whether the gradients on the screen are wanted.
        further: what is added to the loss, (), differentiable by the moment; or None.
        moving: pixels that count more, or None.
    """
    whole = counted is None and moving is None and normal == 1
    whole = whole and moment.features is None and not model.shades
    if whole and isinstance(engine, Comparing):
        found = engine.compare(moment, camera, background, target, measure, sh_degree, tile_weights)
        loss = found.loss if further is None else found.loss + further
        size, gradients = (camera.width, camera.height), gradients_of(loss, model)
        return ViewGradients(loss.detach(), gradients, found.on_screen, size, found.errors)
    frame = model.shade(engine.rasterize(moment, camera, background, sh_degree), instant)
    judged = judge(frame, target, measure, tile_weights, counted, normal, moving)
    return differentiate(judged, frame, model, screens, further)


def compare_views(
    engine: ComparingViews,
    model: Model,
    moments: Sequence[Moment],
    cameras: Sequence[Camera],
    background: Tensor,
    targets: Sequence[Tensor],
    measure: Measure,
    sh_degree: int | None,
    tile_weights: Sequence[Tensor | None],
    further: Sequence[Tensor | None],
) -> list[ViewGradients]:
    """Do what ``compare`` does of several views at once."""
    weights = [own for own in tile_weights if own is not None]
    loss, found = engine.compare_views(
        moments, cameras, background, targets, measure, sh_degree, weights or None
    )
    more = sum_of(further)
    gradients = gradients_of(loss if more is None else loss + more, model)
    nothing = [None] * len(gradients)
    return [
        ViewGradients(
            own.loss if extra is None else own.loss + extra.detach(),
            nothing if i else gradients, own.on_screen, (c.width, c.height), own.errors,
        )
        for i, (own, extra, c) in enumerate(zip(found, further, cameras, strict=True))
    ]  # fmt: skip


class Judged(NamedTuple):
    """What is said of a frame that has been drawn.

    Attributes:
        loss: of the picture.
        unweighted: the loss as if all tiles with a weight above 0 had the weight 1; the very same
            tensor where there are no weights.
        errors: see ``Comparison``.
    """

    loss: Tensor
    unweighted: Tensor
    errors: Tensor | None


def differentiate(
    judged: Judged,
    frame: Frame,
    model: Model,
    screens: bool = True,
    further: Tensor | None = None,
) -> ViewGradients:
    """Return what a frame that has been judged says of a model.

    Args:
        judged: of the frame.
        frame: what was judged.
        model: whose it is.
        screens: whether the gradients on the screen are wanted.
        further: see ``compare``.
    """
    loss = judged.loss if further is None else judged.loss + further
    trained = list(model.trained().values())
    if judged.loss is judged.unweighted:
        # going back through the picture is what takes long: once will do
        wanted = [*trained, frame.means2d]
        *gradients, on_screen = torch.autograd.grad(loss, wanted, allow_unused=True)
    else:
        on_screen = torch.zeros_like(frame.means2d)
        if screens:
            (on_screen,) = torch.autograd.grad(judged.unweighted, frame.means2d, retain_graph=True)
        gradients = [*torch.autograd.grad(loss, trained, allow_unused=True)]
    height, width = frame.alpha.shape
    return ViewGradients(loss.detach(), gradients, on_screen, (width, height), judged.errors)


def judge(
    frame: Frame,
    target: Tensor,
    measure: Measure,
    tile_weights: Tensor | None = None,
    counted: Tensor | None = None,
    normal: float = 1.0,
    moving: Moving | None = None,
) -> Judged:
    """Compare a frame that has been drawn with a target, as ``Comparing.compare`` does.

    Pixels that do not count are taken for right, also by the windows of SSIM. What moves counts
    once with all, and again as if all else were right.
    """
    rgb = frame.rgb
    if counted is not None:
        rgb = _right_outside(counted, rgb, target)
    if normal < 1:
        rgb = _right_outside(inliers(rgb, target, normal), rgb, target)
    errors = None if measure.ssim > 0 else tile_errors(rgb, target, measure.quadratic)
    if moving is not None and errors is not None:
        alone = _right_outside(moving.mask, rgb, target)
        errors = errors + moving.weight * tile_errors(alone, target, measure.quadratic)
    if errors is None or tile_weights is None:
        loss = unweighted = photometric_loss(rgb, target, measure)
        if moving is not None:
            loss = unweighted = loss + _of_moving(rgb, target, measure, moving)
    else:
        errors = errors * (tile_weights > 0)
        loss = ((errors * tile_weights).sum() / target.numel()).to(rgb.dtype)
        unweighted = errors.sum() / target.numel()
    return Judged(loss, unweighted, None if errors is None else errors.detach())


def _right_outside(counted: Tensor, rgb: Tensor, target: Tensor) -> Tensor:
    """Return the picture with the true colours wherever a pixel (H, W) does not count."""
    true = target.permute(1, 2, 0).to(rgb) / 255
    return torch.where(counted.to(rgb.device)[..., None], rgb, true)


def _of_moving(rgb: Tensor, target: Tensor, measure: Measure, moving: Moving) -> Tensor:
    """Return the weighted loss of a picture of which all is right but what moves.

    Only the box around that is looked at, wider by what windows of SSIM reach on either side: what
    they see beyond it is right.
    """
    rows, columns = (moving.mask.any(dim=dim).nonzero()[:, 0].tolist() for dim in (1, 0))
    if not rows:
        return rgb.new_zeros(())
    height, width = moving.mask.shape
    top, bottom = max(rows[0] - 2 * REACH, 0), min(rows[-1] + 2 * REACH + 1, height)
    left, right = max(columns[0] - 2 * REACH, 0), min(columns[-1] + 2 * REACH + 1, width)
    box = slice(top, bottom), slice(left, right)
    wanted = target[:, box[0], box[1]].contiguous()
    shown = _right_outside(moving.mask[box], rgb[box], wanted)
    share = (bottom - top) * (right - left) / (height * width)
    loss: Tensor = moving.weight * share * photometric_loss(shown, wanted, measure)
    return loss
