"""Whether an engine draws here what the reference draws: asked before a GPU is relied on."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from gsdmsr_cli.camera import Camera, look_at
from gsdmsr_cli.errors import GsdmsrError
from gsdmsr_cli.frame import Frame
from gsdmsr_cli.raster import Comparison, reference
from gsdmsr_cli.splats import NAMES, Splats

PICTURE, GRADIENT = 1e-4, 1e-2
"""Largest mean error of a pixel, and relative error of a gradient in the L2 norm. Both are far
above rounding: single pixels may jump where alpha is next to its cut-off."""

_COUNT, _WIDTH, _HEIGHT = 60, 52, 37
_BACKGROUND = torch.tensor([0.2, 0.5, 0.9])


def disagreement(
    draw: Callable[..., Frame], compare: Callable[..., Comparison], device: str
) -> str | None:
    """Return how an engine errs on the device, one clause, or None.

    Args:
        draw, compare: the engine's, see ``Comparing``.
        device: where its tensors lie.
    """
    exact = _drawn(reference.rasterize, "cpu", torch.float64)
    true = _compared(_distance, "cpu", torch.float64)
    try:
        found = _drawn(draw, device, torch.float32)
        ours = _compared(compare, device, torch.float32)
    except (GsdmsrError, RuntimeError) as failure:
        return f"it fails a test drawing: {str(failure).splitlines()[0]}"
    if not (found[0].cpu() - exact[0]).abs().mean() <= PICTURE:
        return "the picture of a test drawing is wrong"
    if not (ours[0].cpu() - true[0]).abs() <= PICTURE:
        return "the loss of a test drawing is wrong"
    pairs = zip(NAMES * 2, found[1:] + ours[1:], exact[1:] + true[1:], strict=True)
    for name, gradient, truth in pairs:
        if not (gradient.cpu() - truth).norm() <= GRADIENT * truth.norm():
            return f"the gradient of {name} of a test drawing is wrong"
    return None


def _drawn(draw: Callable[..., Frame], device: str, dtype: torch.dtype) -> list[Tensor]:
    """Return a picture with its depth, and the gradients of a weighted sum of its values."""
    rng, splats = _generator(), _splats(device, dtype)
    frame = draw(splats, _camera(), _BACKGROUND.to(device, dtype), None, True)
    assert frame.depth is not None
    parts = [frame.rgb, frame.alpha[..., None], frame.depth[..., None]]
    picture = torch.cat(parts, dim=2)
    weights = torch.randn(picture.shape, generator=rng).to(picture)
    gradients = torch.autograd.grad((picture * weights).sum(), [*splats.tensors().values()])
    return [picture.detach(), *gradients]


def _compared(compare: Callable[..., Comparison], device: str, dtype: torch.dtype) -> list[Tensor]:
    """Return the mean distance from a target, and its gradients."""
    splats, shape = _splats(device, dtype), (3, _HEIGHT, _WIDTH)
    target = torch.randint(256, shape, generator=_generator(), dtype=torch.uint8).to(device)
    loss = compare(splats, _camera(), _BACKGROUND.to(device, dtype), target, 0.0).loss
    return [loss.detach(), *torch.autograd.grad(loss, [*splats.tensors().values()])]


def _distance(
    splats: Splats, camera: Camera, background: Tensor, target: Tensor, _ssim_weight: float
) -> Comparison:
    """Compare as the reference would."""
    rgb = reference.rasterize(splats, camera, background).rgb
    loss = (rgb - target.permute(1, 2, 0) / 255).abs().mean()
    return Comparison(loss, torch.empty(0), None)


def _generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def _camera() -> Camera:
    pose = look_at(np.array([2.4, -1.2, 2.9]), np.zeros(3), np.array([0.1, 0.2, 1.0]))
    return Camera(pose, 50.0, 55.0, _WIDTH / 2, _HEIGHT / 2, _WIDTH, _HEIGHT)


def _splats(device: str, dtype: torch.dtype) -> Splats:
    rng = _generator()
    splats = Splats(
        means=0.7 * torch.randn(_COUNT, 3, generator=rng),
        quats=torch.randn(_COUNT, 4, generator=rng),
        log_scales=math.log(0.12) + 0.5 * torch.randn(_COUNT, 3, generator=rng),
        logit_opacities=torch.randn(_COUNT, generator=rng),
        sh=0.3 * torch.randn(_COUNT, 4, 3, generator=rng),
    )
    return splats.map(lambda tensor: tensor.to(device, dtype).requires_grad_())
