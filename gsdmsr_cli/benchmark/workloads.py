"""What is timed: drawing forward and backward, and a whole training step."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from gsdmsr_cli.benchmark.cloud import camera, cloud
from gsdmsr_cli.drawing.splatting import draw
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.model.building import start_model
from gsdmsr_cli.model.layer import Facts
from gsdmsr_cli.ops.planes import CUBE
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.training.gradients.compare import compare
from gsdmsr_cli.training.optimizer import Adam

TIME = 0.65
FRAMES = 200
SSIM_WEIGHT = 0.2
NOISE = 0.05


def target_of(rgb: Tensor) -> Tensor:
    """Return an 8-bit target (3, H, W): the picture with noise, so that every pixel has a loss."""
    noise = torch.randn(rgb.shape, generator=torch.Generator().manual_seed(0)) * NOISE
    picture = (rgb.detach() + noise).clamp(0, 1)
    return (picture * 255).to(torch.uint8).permute(2, 0, 1).contiguous()


def drawing(size: int, count: int, device: str = "cpu") -> Callable[[], None]:
    """Return a function that draws degree-0 splats and takes the gradients of all stored values.

    It waits for the device, "cpu" or "cuda", and so does that of ``training_step``.
    """
    splats = cloud(count).map(lambda t: t.to(device).requires_grad_(True))
    engine, view, background = best_engine(device), camera(size), torch.ones(3, device=device)
    slope = slope_of(size, device)

    def run() -> None:
        frame = engine.rasterize(Moment(splats), view, background)
        frame.rgb.backward(slope.permute(1, 2, 0))  # type: ignore[no-untyped-call]
        for tensor in splats.tensors().values():
            tensor.grad = None
        wait(device)

    return run


def slope_of(size: int, device: str) -> Tensor:
    """Return the gradient (3, size, size) that drawings are differentiated with."""
    return torch.randn(3, size, size, generator=_generator()).to(device)


def wait(device: str) -> None:
    """Return when the device has done what it was given."""
    if device != "cpu":
        torch.cuda.synchronize()


def training_step(size: int, count: int, motion: str, device: str = "cpu") -> Callable[[], None]:
    """Return a function that makes a training step at rate 0: L1 + SSIM, one view."""
    facts = Facts(1.0, CUBE, FRAMES)
    model = start_model(cloud(count), {"name": motion}, (), facts, _generator()).to(device)
    model.advance(1.0)
    engine, view, background = best_engine(device), camera(size), torch.ones(3, device=device)
    target = target_of(draw(model, view, TIME, engine, background).rgb.cpu()).to(device)
    optimizer, rates = Adam(), dict.fromkeys(model.tensors(), 0.0)

    def run() -> None:
        moment = model.at(model.instant(TIME, view))
        found = compare(engine, model, moment, view, background, target, SSIM_WEIGHT)
        for tensor, gradient in zip(model.trained().values(), found.gradients, strict=True):
            tensor.grad = gradient
        optimizer.step(model.trained(), rates)
        wait(device)

    return run


def _generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)
