"""Checks that an engine draws on this machine what the reference draws, before a GPU is used."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import NAMES, Splats
from gsdmsr_cli.ground.errors import GsdmsrError
from gsdmsr_cli.ground.measure import Measure
from gsdmsr_cli.ground.splatting_constants import TILE, tile_grid
from gsdmsr_cli.ops.photometric.twin import distances, ssim
from gsdmsr_cli.raster import Comparison, reference
from gsdmsr_cli.scene.camera import Camera, look_at

PICTURE, GRADIENT = 1e-4, 1e-2
"""Largest mean error of a pixel, and relative error of a gradient in the L2 norm. Both are far
above rounding: single pixels may jump where alpha is next to its cut-off."""

_COUNT, _WIDTH, _HEIGHT = 60, 52, 37
_BACKGROUND = torch.tensor([0.2, 0.5, 0.9])

_LOSSES = {
    "loss": (Measure(0.0), False),
    "SSIM loss": (Measure(0.2), False),
    "loss of squares": (Measure(0.0, 0.3), False),
    "loss of weighted tiles": (Measure(0.0), True),
}
"""By name how pictures are compared, and whether tiles are weighted."""


def disagreement(
    draw: Callable[..., Frame], compare: Callable[..., Comparison], device: str
) -> str | None:
    """Return how an engine errs on the device, one clause, or None.

    Args:
        draw, compare: the engine's, see ``Comparing``.
        device: where its tensors lie.
    """
    exact = _drawn(reference.rasterize, "cpu", torch.float64)
    try:
        wrong = _error(_drawn(draw, device, torch.float32), exact, "picture")
        for name, how in _LOSSES.items():
            exact = _compared(_compare_exactly, "cpu", torch.float64, *how)
            found = _compared(compare, device, torch.float32, *how)
            wrong = wrong or _error(found, exact, name)
    except (GsdmsrError, RuntimeError) as failure:
        return f"it fails a test drawing: {str(failure).splitlines()[0]}"
    return wrong


def _error(found: list[Tensor], exact: list[Tensor], what: str) -> str | None:
    """Return how a value and its gradients by the stored tensors err, one clause, or None."""
    if not (found[0].cpu() - exact[0]).abs().mean() <= PICTURE:
        return f"the {what} of a test drawing is wrong"
    for name, gradient, truth in zip(NAMES, found[1:], exact[1:], strict=True):
        if not (gradient.cpu() - truth).norm() <= GRADIENT * truth.norm():
            return f"the gradient of {name} by the {what} of a test drawing is wrong"
    return None


def _drawn(draw: Callable[..., Frame], device: str, dtype: torch.dtype) -> list[Tensor]:
    """Return a picture with its depth, and the gradients of a weighted sum of its values."""
    rng, splats = _generator(), _splats(device, dtype)
    frame = draw(Moment(splats), _camera(), _BACKGROUND.to(device, dtype), None, True)
    assert frame.depth is not None
    parts = [frame.rgb, frame.alpha[..., None], frame.depth[..., None]]
    picture = torch.cat(parts, dim=2)
    weights = torch.randn(picture.shape, generator=rng).to(picture)
    gradients = torch.autograd.grad((picture * weights).sum(), [*splats.tensors().values()])
    return [picture.detach(), *gradients]


def _compared(
    compare: Callable[..., Comparison],
    device: str,
    dtype: torch.dtype,
    measure: Measure,
    weighted: bool,
) -> list[Tensor]:
    """Return the loss against a target, and its gradients."""
    splats, shape = _splats(device, dtype), (3, _HEIGHT, _WIDTH)
    target = torch.randint(256, shape, generator=_generator(), dtype=torch.uint8).to(device)
    rows, columns = tile_grid(_WIDTH, _HEIGHT)
    weights = (torch.arange(rows * columns) % 3).to(device, dtype) if weighted else None
    background = _BACKGROUND.to(device, dtype)
    given = Moment(splats), _camera(), background, target, measure, None, weights
    loss = compare(*given).loss
    return [loss.detach(), *torch.autograd.grad(loss, [*splats.tensors().values()])]


def _compare_exactly(
    moment: Moment,
    camera: Camera,
    background: Tensor,
    target: Tensor,
    measure: Measure,
    _sh_degree: None,
    tile_weights: Tensor | None,
) -> Comparison:
    """Compare as the reference would."""
    drawn = reference.rasterize(moment, camera, background).rgb.permute(2, 0, 1)
    wanted = target.to(drawn.dtype) / 255
    apart = distances(drawn - wanted, measure.quadratic)
    if tile_weights is not None:
        by_tile = tile_weights.view(tile_grid(camera.width, camera.height))
        by_pixel = by_tile.repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)
        apart = apart * by_pixel[: camera.height, : camera.width]
    loss = (1 - measure.ssim) * apart.mean() + measure.ssim * (1 - ssim(drawn, wanted))
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
