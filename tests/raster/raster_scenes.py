"""Small scenes at the sizes and places where rasterizers break, and how engines are compared."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import SH_C0, quat_to_rotmat
from gsdmsr_cli.ground.splatting_constants import ALPHA_MAX, ALPHA_MIN, NEAR, TILE
from gsdmsr_cli.raster import Engine, reference
from gsdmsr_cli.scene.camera import Camera, look_at


@dataclass(frozen=True, eq=False)
class Case:
    """One picture to draw; tensors are float32 on the CPU.

    past_stop says that pixels are finished while splats are left: an engine may blend those or
    not, see TRANSMITTANCE_STOP.
    """

    splats: Splats
    camera: Camera
    background: Tensor
    sh_degree: int | None = None
    with_depth: bool = True
    past_stop: bool = False
    axes: Tensor | None = None
    features: Tensor | None = None

    @property
    def moment(self) -> Moment:
        """What is drawn."""
        return Moment(self.splats, self.axes, self.features)


@dataclass(frozen=True, eq=False)
class Drawing:
    """A frame with the gradients of a weighted sum of its pixels, by tensor, on the CPU."""

    frame: Frame
    gradients: dict[str, Tensor]


def camera(width: int, height: int, **changes: Any) -> Camera:
    """Camera 4 units from the origin, askew, with a field of view of about 50 degrees."""
    pose = look_at(np.array([2.4, -1.2, 2.96]), np.zeros(3), np.array([0.1, 0.2, 1.0]))
    focal = 1.07 * max(width, height)
    plain = Camera(pose, focal, focal, width / 2, height / 2, width, height)
    return replace(plain, **changes)


def splats(
    count: int,
    degree: int = 1,
    seed: int = 0,
    size: float = 0.12,
    spread: float = 0.8,
    logit: tuple[float, float] = (0.0, 2.0),
) -> Splats:
    """Random splats: means normal about the origin, scales about ``size``, logit mean and sigma."""
    rng = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng)

    sh = normal(count, (degree + 1) ** 2, 3) * 0.3
    sh[:, 0] /= SH_C0
    return Splats(
        means=normal(count, 3) * spread,
        quats=normal(count, 4) * normal(count, 1).exp(),
        log_scales=np.log(size) + 0.5 * normal(count, 3),
        logit_opacities=logit[0] + logit[1] * normal(count),
        sh=sh,
    )


def at_pixels(view: Camera, pixels: Tensor, depths: Tensor) -> Tensor:
    """Return the (N, 3) world points at (N, 2) screen positions [px] and (N,) camera z."""
    slopes = (pixels - torch.tensor([view.cx, view.cy])) / torch.tensor([view.fx, view.fy])
    in_camera = torch.cat([slopes, torch.ones_like(slopes[:, :1])], -1) * depths.unsqueeze(-1)
    rotation, centre = torch.tensor(view.rotation), torch.tensor(view.centre)
    return (in_camera.double() @ rotation + centre).float()


def _case(width: int, height: int, of: Splats, **changes: Any) -> Case:
    return Case(of, camera(width, height, **changes), torch.tensor([0.2, 0.5, 0.9]))


def _tile_edges() -> Case:
    view = camera(48, 48)
    edges = torch.tensor([0.0, 0.5, 15.5, 16.0, 16.5, 31.5, 32.0, 47.5, 48.0])
    grid = torch.cartesian_prod(edges, edges)
    shuffled = torch.randperm(len(grid), generator=torch.Generator().manual_seed(5))
    depths = torch.linspace(3.0, 5.0, len(grid))[shuffled]
    small = splats(len(grid), seed=5, size=0.05)
    return Case(replace(small, means=at_pixels(view, grid, depths)), view, torch.zeros(3))


def _near_plane() -> Case:
    # The camera is at the origin: elsewhere float32 means would not resolve pixels so near to it.
    pose = camera(33, 33).world_to_camera.copy()
    pose[:3, 3] = 0
    view = camera(33, 33, world_to_camera=pose)
    depths = torch.tensor([-4.0, -0.3, 0.0, 0.19, NEAR - 1e-3, NEAR + 1e-3, 0.21, 0.3, 1.0, 3.0])
    rng = torch.Generator().manual_seed(6)
    depths = depths.repeat(4) + 1e-4 * torch.rand(4 * len(depths), generator=rng)
    pixels = 33 * torch.rand(len(depths), 2, generator=rng)
    small = splats(len(depths), seed=6, size=0.01)
    return Case(replace(small, means=at_pixels(view, pixels, depths)), view, torch.ones(3))


def _zero_quats() -> Case:
    some = splats(40, seed=7)
    some.quats[::3] = 0
    return _case(33, 17, some)


def _outside_the_margin() -> Case:
    """Large splats whose means lie beside the image, so that the Jacobian's clamp is at work."""
    view = camera(40, 24)
    pixels = torch.tensor([[-30.0, 5.0], [70.0, 20.0], [20.0, -40.0], [10.0, 60.0], [-20.0, 50.0]])
    depths = torch.tensor([2.0, 2.5, 3.0, 3.5, 1.5])
    large = splats(5, seed=8, size=0.9, logit=(1.0, 0.5))
    return Case(replace(large, means=at_pixels(view, pixels, depths)), view, torch.ones(3))


def with_axes(of: Case, seed: int = 22) -> Case:
    """Return the case with covariances by axes, turned from the right, and no quats and scales."""
    rng = torch.Generator().manual_seed(seed)
    turns = quat_to_rotmat(torch.randn(len(of.splats), 4, generator=rng))
    scaled = quat_to_rotmat(of.splats.quats) * of.splats.log_scales.exp().unsqueeze(1)
    nothing = {n: torch.full_like(getattr(of.splats, n), math.nan) for n in ("quats", "log_scales")}
    return replace(of, splats=replace(of.splats, **nothing), axes=scaled @ turns)


def with_features(of: Case, count: int, seed: int = 23) -> Case:
    """Return the case with so many features, below 0 as well."""
    rng = torch.Generator().manual_seed(seed)
    return replace(of, features=torch.randn(len(of.splats), count, generator=rng))


def _needles() -> Splats:
    some = splats(60, seed=18)
    return replace(some, log_scales=some.log_scales + torch.tensor([1.5, -4.0, -4.0]))


def poisoned() -> tuple[Case, Case, Tensor]:
    """A case with non-finite rows, the same without them, and the rows that are finite."""
    some = splats(48, degree=2, seed=9)
    values = (float("nan"), float("inf"), -float("inf"))
    for i, tensor in enumerate(some.tensors().values()):
        for j, value in enumerate(values):
            tensor[1 + 3 * i + j].view(-1)[-1] = value
    finite = torch.cat([torch.tensor([0]), torch.arange(16, 48)])
    sick = _case(50, 37, some)
    return sick, replace(sick, splats=some.take(finite)), finite


def poisoned_moment() -> tuple[Case, Case, Tensor]:
    """The same of a case with axes and features, in which these have rows that are not finite."""
    sick = with_features(with_axes(_case(50, 37, splats(48, seed=24))), 5)
    assert sick.axes is not None and sick.features is not None
    for i, value in enumerate((math.nan, math.inf, -math.inf)):
        sick.axes[1 + i, i, 2 - i] = value
        sick.features[4 + i, 2 * i] = value
    finite = torch.cat([torch.tensor([0]), torch.arange(7, 48)])
    kept = {"axes": sick.axes[finite], "features": sick.features[finite]}
    return sick, replace(sick, splats=sick.splats.take(finite), **kept), finite


def overflowing() -> Case:
    """Finite values whose squares, exponentials or quotients are not finite in float32."""
    some = splats(32, seed=19)
    some.means[0] *= 1e30
    some.means[1] *= -1e30
    some.means[2] = float(torch.finfo().max)
    for row, size in enumerate((20.0, 30.0, 50.0, 100.0, 1e30, -100.0, -1e30)):
        some.log_scales[3 + row] = size
    some.log_scales[10, 0] = 30.0
    for row, size in enumerate((1e-30, 1e-15, 1e-12, 1e15, 1e30)):
        some.quats[11 + row] *= size
    some.logit_opacities[16], some.logit_opacities[17] = 1e30, -1e30
    some.sh[18] = 1e30
    return _case(20, 18, some)


CASES: dict[str, Callable[[], Case]] = {
    "1x1": lambda: _case(1, 1, splats(12, size=0.4, logit=(-1.0, 1.0))),
    "16x16": lambda: _case(16, 16, splats(60)),
    "17x33": lambda: _case(17, 33, splats(80, seed=1)),
    "50x37": lambda: _case(50, 37, splats(120, seed=2)),
    "64x48": lambda: _case(64, 48, splats(150, seed=10)),
    "more than a batch in a tile": lambda: _case(
        TILE, TILE, splats(700, seed=3, size=0.3, logit=(-3.5, 1.0))
    ),
    "more than a batch in a tile, opaque": lambda: replace(
        _case(TILE, TILE, splats(700, seed=4, size=0.3, logit=(2.0, 3.0))), past_stop=True
    ),
    "tile edges": _tile_edges,
    "behind and at the near plane": _near_plane,
    "zero quaternions": _zero_quats,
    "outside the margin": _outside_the_margin,
    "poison": lambda: poisoned()[0],
    "zero splats": lambda: _case(20, 18, splats(0)),
    "none in view": lambda: _case(20, 18, replace(splats(3), means=torch.full((3, 3), 30.0))),
    "tiny": lambda: _case(40, 40, splats(150, seed=11, size=1e-4)),
    "huge": lambda: _case(40, 40, splats(20, seed=12, size=3.0, logit=(-1.0, 1.0))),
    "needles": lambda: _case(40, 40, _needles()),
    "off-centre, fx != fy": lambda: _case(
        50, 37, splats(80, seed=13), fx=47.0, fy=71.0, cx=11.3, cy=29.9
    ),
    "sh degree 0": lambda: _case(24, 24, splats(40, degree=0, seed=14)),
    "sh degree 2": lambda: _case(24, 24, splats(40, degree=2, seed=15)),
    "sh degree 3": lambda: _case(24, 24, splats(40, degree=3, seed=16)),
    "active degree 0 of 3": lambda: replace(CASES["sh degree 3"](), sh_degree=0),
    "active degree 2 of 3": lambda: replace(CASES["sh degree 3"](), sh_degree=2),
    "saturated": lambda: _case(40, 33, splats(30, seed=17, logit=(12.0, 3.0))),
    "without depth": lambda: replace(CASES["50x37"](), with_depth=False),
} | {
    f"{name}, axes": partial(lambda name: with_axes(CASES[name]()), name)
    for name in (
        "1x1", "17x33", "more than a batch in a tile", "tile edges", "behind and at the near plane",
        "outside the margin", "zero splats", "none in view", "tiny", "huge", "needles",
        "off-centre, fx != fy", "sh degree 3", "saturated", "without depth",
    )
}  # fmt: skip
CASES["one splat, axes"] = lambda: with_axes(_case(17, 9, splats(1, seed=25, logit=(2.0, 0.0))))
"""By name; without features."""

WITH_FEATURES: dict[str, Callable[[], Case]] = {
    f"{name}, {count} features": partial(
        lambda name, count: with_features(CASES[name](), count), name, count
    )
    for name, count in (
        ("1x1", 3), ("17x33", 1), ("50x37", 9), ("more than a batch in a tile", 4),
        ("zero splats", 9), ("none in view", 1), ("needles", 4), ("saturated", 9),
        ("without depth", 3), ("zero splats, axes", 3), ("17x33, axes", 9),
        ("needles, axes", 3), ("saturated, axes", 4), ("one splat, axes", 1),
        ("off-centre, fx != fy, axes", 9),
    )
}  # fmt: skip
"""Further ones, which are drawn but not compared in one go."""


@cache
def case(name: str) -> Case:
    """Return one of CASES or WITH_FEATURES; nobody may write to its tensors."""
    return (CASES | WITH_FEATURES)[name]()


def draw(engine: Engine, scene: Case, weights: Tensor, device: str, dtype: torch.dtype) -> Drawing:
    """Draw the case and differentiate its pixels times the (H, W, 5 + F) weights."""
    leaves = scene.moment.map(lambda t: t.to(device, dtype, copy=True).requires_grad_())
    background = scene.background.to(device, dtype)
    frame = engine.rasterize(leaves, scene.camera, background, scene.sh_degree, scene.with_depth)
    frame.means2d.retain_grad()
    depth = frame.alpha * 0 if frame.depth is None else frame.depth
    parts = [frame.rgb, frame.alpha.unsqueeze(-1), depth.unsqueeze(-1)]
    pixels = torch.cat(parts if frame.features is None else [*parts, frame.features], -1)
    (pixels * weights.to(pixels)).sum().backward()
    gradients = {}
    for name, tensor in {**leaves.tensors(), "means2d": frame.means2d}.items():
        found = torch.zeros_like(tensor) if tensor.grad is None else tensor.grad
        gradients[name] = found.cpu()
    drawn = {n: t if t is None else t.detach().cpu() for n, t in vars(frame).items()}
    return Drawing(Frame(**drawn), gradients)


def pixel_weights(scene: Case, seed: int = 0) -> Tensor:
    """Random (H, W, 5 + F) weights of rgb, alpha, depth and features; 0 where ``ambiguous``."""
    channels = 5 if scene.features is None else 5 + scene.features.shape[1]
    shape = (scene.camera.height, scene.camera.width, channels)
    weights = torch.randn(shape, generator=torch.Generator().manual_seed(seed))
    return weights.double() * ~ambiguous(scene).unsqueeze(-1)


@cache
@torch.no_grad()
def ambiguous(scene: Case, margin: float = 1e-4) -> Tensor:
    """Return (H, W) which pixels have a splat whose alpha is within ``margin`` of a threshold.

    At the cut-off the picture jumps by up to ALPHA_MIN and at saturation the gradient jumps to 0,
    so there no float32 engine can be held to a float64 one. The margin is relative.
    """
    view, exact = scene.camera, scene.moment.map(torch.Tensor.double)
    drawn = reference.rasterize(exact, view, scene.background.double()).radii.nonzero().squeeze(-1)
    seen = reference.project(exact.take(drawn), view)
    xs, ys = torch.arange(view.width) + 0.5, torch.arange(view.height) + 0.5
    pixels = torch.cartesian_prod(ys, xs).flip(-1).double()
    offsets = pixels.unsqueeze(1) - seen.means2d
    distance2 = torch.einsum("pni,nij,pnj->pn", offsets, seen.covs2d.inverse(), offsets)
    alphas = seen.opacities * (-0.5 * distance2).exp()
    close = ((alphas / ALPHA_MIN - 1).abs() < margin) | ((alphas / ALPHA_MAX - 1).abs() < margin)
    return close.any(-1).view(view.height, view.width)
