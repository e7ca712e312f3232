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
from gsdmsr_cli.raster import reference
from gsdmsr_cli.splats import NAMES, Splats

PICTURE, GRADIENT = 1e-4, 1e-2
"""Largest mean error of a pixel, and relative error of a gradient in the L2 norm. Both are far
above rounding: single pixels may jump where alpha is next to its cut-off."""

_COUNT, _WIDTH, _HEIGHT = 60, 52, 37


def disagreement(draw: Callable[..., Frame], device: str) -> str | None:
    """Return how the engine that ``draw`` belongs to errs on the device, one clause, or None.

    Args:
        draw: see ``Engine.rasterize``.
        device: where its tensors lie.
    """
    try:
        found = _drawn(draw, device, torch.float32)
    except (GsdmsrError, RuntimeError) as failure:
        return f"it fails a test drawing: {str(failure).splitlines()[0]}"
    exact = _drawn(reference.rasterize, "cpu", torch.float64)
    errors = [ours.cpu().double() - truth for ours, truth in zip(found, exact, strict=True)]
    if not errors[0].abs().mean() <= PICTURE:
        return "the picture of a test drawing is wrong"
    for name, error, truth in zip(NAMES, errors[1:], exact[1:], strict=True):
        if not error.norm() <= GRADIENT * truth.norm():
            return f"the gradient of {name} of a test drawing is wrong"
    return None


def _drawn(draw: Callable[..., Frame], device: str, dtype: torch.dtype) -> list[Tensor]:
    """Return a picture with its depth, and the gradients of a weighted sum of its values."""
    rng = torch.Generator().manual_seed(0)
    splats = _splats(rng).map(lambda t: t.to(device, dtype).requires_grad_())
    frame = draw(splats, _camera(), torch.tensor([0.2, 0.5, 0.9]).to(device, dtype), None, True)
    assert frame.depth is not None
    parts = [frame.rgb, frame.alpha[..., None], frame.depth[..., None]]
    picture = torch.cat(parts, dim=2)
    weights = torch.randn(picture.shape, generator=rng).to(picture)
    gradients = torch.autograd.grad((picture * weights).sum(), [*splats.tensors().values()])
    return [picture.detach(), *gradients]


def _camera() -> Camera:
    pose = look_at(np.array([2.4, -1.2, 2.9]), np.zeros(3), np.array([0.1, 0.2, 1.0]))
    return Camera(pose, 50.0, 55.0, _WIDTH / 2, _HEIGHT / 2, _WIDTH, _HEIGHT)


def _splats(rng: torch.Generator) -> Splats:
    return Splats(
        means=0.7 * torch.randn(_COUNT, 3, generator=rng),
        quats=torch.randn(_COUNT, 4, generator=rng),
        log_scales=math.log(0.12) + 0.5 * torch.randn(_COUNT, 3, generator=rng),
        logit_opacities=torch.randn(_COUNT, generator=rng),
        sh=0.3 * torch.randn(_COUNT, 4, 3, generator=rng),
    )
