"""What is timed: drawing, following control points, both with gradients, and a whole step."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gsdmsr_cli.benchmark.cloud import camera, cloud
from gsdmsr_cli.drawing.splatting import draw
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.measure import Measure
from gsdmsr_cli.model.building import start_model
from gsdmsr_cli.model.layer import Facts
from gsdmsr_cli.model.motion.control_points import Options
from gsdmsr_cli.ops import skin, spread
from gsdmsr_cli.ops.displace import OUTPUTS
from gsdmsr_cli.ops.nearest import Nearest
from gsdmsr_cli.ops.planes import CUBE
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.training.gradients.compare import compare
from gsdmsr_cli.training.optimizer import Adam

TIME = 0.65
FRAMES = 200
COMPARED = Measure(0.2)
NOISE = 0.05
MOVE, MOVES = 1e-4, 16
"""By how much splats and control points go along each axis in a step, and after how many again."""


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
        instant = model.instant(TIME, view)
        moment = model.at(instant)
        found = compare(engine, model, moment, instant, view, background, target, COMPARED)
        for tensor, gradient in zip(model.trained().values(), found.gradients, strict=True):
            tensor.grad = gradient
        optimizer.step(model.trained(), rates)
        wait(device)

    return run


def following(count: int, device: str = "cpu") -> Callable[[], None]:
    """Return a function that lets splats follow control points, and takes all gradients.

    That is the search for the nearest, their transforms and skinning. Splats and control points
    move a little between calls, as they do in training.
    """
    rng, options = _generator(), Options()
    splats = cloud(count).map(lambda t: t.to(device).requires_grad_(True))
    points = spread.spread_out(splats.means, options.count)
    made = spread.spacing(points).log(), 0.1 * torch.randn(options.count, OUTPUTS, generator=rng)
    log_radii, deformation = (t.to(device).requires_grad_(True) for t in made)
    slopes = [torch.randn(count, width, generator=rng).to(device) for width in (3, 4, 3)]
    walks = [_walk(splats.means, rng), _walk(points.to(device), rng)]
    search, moments = Nearest(options.neighbours), itertools.cycle(zip(*walks, strict=True))

    def run() -> None:
        means, control_points = next(moments)
        near = search.find(means, control_points)
        transforms = skin.transforms(control_points, deformation)
        there = replace(splats, means=means)
        moved = skin.skin(there, control_points, log_radii, transforms, near)
        parts = [moved.means, moved.quats, moved.log_scales]
        torch.autograd.backward(parts, slopes)
        for tensor in (*there.tensors().values(), control_points, log_radii, deformation):
            tensor.grad = None
        wait(device)

    return run


def _walk(places: Tensor, generator: torch.Generator) -> Sequence[Tensor]:
    """Return places (N, 3) after each of so many steps in random directions, with gradients."""
    steps = MOVE * torch.randn(MOVES, *places.shape, generator=generator).to(places.device)
    return [place.requires_grad_(True) for place in places.detach() + steps.cumsum(dim=0)]


def _generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)
