"""Checks that the operations of a training step give on a GPU what their twins give.

Each is asked with float32 on the device and with float64 on the CPU, where its plain torch twin, or
a closed form, answers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import GsdmsrError
from gsdmsr_cli.ops import displace as deformation
from gsdmsr_cli.ops import hash_grid, network, planes, precision
from gsdmsr_cli.ops import skin as skinning
from gsdmsr_cli.ops.adam.cuda import Row, adam
from gsdmsr_cli.ops.cube_map import show_behind
from gsdmsr_cli.ops.hats import hats
from gsdmsr_cli.ops.lighting import light
from gsdmsr_cli.ops.nearest import nearest_points
from gsdmsr_cli.ops.series import add_series
from gsdmsr_cli.ops.slices import slices
from gsdmsr_cli.scene.camera import Camera

Values = dict[str, Tensor]

FLOAT32 = 1e-4
"""Largest relative error in the L2 norm: a hundred times what rounding makes of sums of some
hundred products, and far below what a missing or doubled term does."""

_COUNT, _POINTS, _NEAR = 150, 40, 8
"""Splats, more than a block of threads has; control points, no multiple of a warp; neighbours."""


class _Operation(NamedTuple):
    """An operation of a step.

    Attributes:
        work: returns what it makes of test values on a device in a format, by what that is.
        tolerance: relative in the L2 norm.
        format: what it computes in on a GPU, see ``ops.precision``.
    """

    work: Callable[[str, torch.dtype], Values]
    tolerance: float
    format: str = "float32"


def operations_disagreement(device: str) -> str | None:
    """Return which operation errs on the device, one clause, or None."""
    for name, (work, tolerance, chosen) in OPERATIONS.items():
        try:
            with precision.computing_in(chosen):
                found = {what: value.cpu() for what, value in work(device, torch.float32).items()}
        except (GsdmsrError, RuntimeError) as failure:
            return f"{name} fails on test values: {str(failure).splitlines()[0]}"
        for what, exact in work("cpu", torch.float64).items():
            if not (found[what] - exact).norm() <= tolerance * exact.norm():
                return f"{name} makes wrong {what} of test values"
    return None


def _leaves(device: str, dtype: torch.dtype, *tensors: Tensor) -> list[Tensor]:
    return [tensor.detach().to(device, dtype, copy=True).requires_grad_() for tensor in tensors]


def _with_gradients(value: Tensor, names: Sequence[str], leaves: Sequence[Tensor]) -> Values:
    """Return a value and the gradients of a weighted sum of it, to which some rows add nothing."""
    slopes = _random(*value.shape, seed=9)
    if value.dim():
        slopes[::3] = 0
    gradients = torch.autograd.grad(value, leaves, slopes.to(value))
    of = (f"gradients of {name}" for name in names)
    return {"values": value.detach(), **dict(zip(of, gradients, strict=True))}


def _random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def _grids(device: str, dtype: torch.dtype) -> list[Tensor]:
    """Return the tensors of two levels, with temporal planes that are neither 1 nor smooth."""
    rng = torch.Generator().manual_seed(0)
    levels = [planes.new_level(4, 3, 32, rng), planes.new_level(9, 5, 16, rng)]
    times = [level.time + 0.3 * torch.randn(level.time.shape, generator=rng) for level in levels]
    moved = [level.space for level in levels], times
    return _leaves(device, dtype, *(part for pair in zip(*moved, strict=True) for part in pair))


def _levels(tensors: Sequence[Tensor]) -> list[planes.Level]:
    return [planes.Level(*pair) for pair in zip(tensors[::2], tensors[1::2], strict=True)]


_GRID_NAMES = ("coarse space", "coarse time", "fine space", "fine time")


def _look_up(device: str, dtype: torch.dtype) -> Values:
    tensors = _grids(device, dtype)
    points, beside = _leaves(device, dtype, 0.7 * _random(_COUNT, 3), _random(_COUNT, 3, seed=1))
    given = _levels(tensors), points, [-0.37, 0.6]
    found = (planes.lookup_at_times(*given, beside=beside, degree=d) for d in planes.DEGREES)
    features = torch.cat([*found])
    names = ("points", "features beside", *_GRID_NAMES)
    return _with_gradients(features, names, [points, beside, *tensors])


def _penalise(device: str, dtype: torch.dtype) -> Values:
    tensors = _grids(device, dtype)
    value = planes.penalty(_levels(tensors), 0.3, 0.7, 0.2)
    return _with_gradients(value, _GRID_NAMES, tensors)


_HASH_LEVELS = hash_grid.Levels(((5, 4, 3), (17, 12, 9)), 128)
"""One level with a row for each grid point, and one that has a hash."""


def _look_up_hashed(device: str, dtype: torch.dtype) -> Values:
    rows = _HASH_LEVELS.offsets[-1]
    leaves = _leaves(device, dtype, _random(rows, 2), 0.7 * _random(_COUNT, 3, seed=1))
    features = hash_grid.lookup(_HASH_LEVELS, *leaves)
    return _with_gradients(features, ("the table", "points"), leaves)


def _find_nearest(device: str, dtype: torch.dtype) -> Values:
    points, control_points = (
        t.to(device, dtype) for t in (_random(_COUNT, 3), _random(_POINTS, 3, seed=1))
    )
    guesses = torch.zeros(_COUNT, _NEAR, dtype=torch.int32, device=device)
    return {"rows": nearest_points(points, control_points, guesses).double()}


def _transform(device: str, dtype: torch.dtype) -> Values:
    leaves = _leaves(device, dtype, _random(_POINTS, 3), 0.3 * _random(_POINTS, 10, seed=1))
    return _with_gradients(skinning.transforms(*leaves), ("control_points", "deformations"), leaves)


def _stored() -> list[Tensor]:
    return [_random(_COUNT, width, seed=width) for width in (3, 4, 3)]


def _together(move: Callable[[Splats], Splats], stored: Sequence[Tensor]) -> Tensor:
    """Return the means, quaternions and log scales of moved splats, side by side."""
    means, quats, log_scales = stored
    nothing = means.new_zeros(_COUNT, 1, 3)
    moved = move(Splats(means, quats, log_scales, nothing[:, 0, 0], nothing))
    return torch.cat([moved.means, moved.quats, moved.log_scales], dim=1)


_STORED_NAMES = ("means", "quats", "log scales")


def _skin(device: str, dtype: torch.dtype) -> Values:
    by = _random(_POINTS, 3), 0.3 * _random(_POINTS, seed=1) - 1, 0.3 * _random(_POINTS, 19, seed=2)
    leaves = _leaves(device, dtype, *_stored(), *by)
    rows = _random(_COUNT, _POINTS, seed=3).argsort(dim=1)[:, :_NEAR].sort(dim=1).values
    near = rows.to(device, torch.int32)
    *stored, control_points, log_radii, transforms = leaves
    moved = _together(
        lambda splats: skinning.skin(splats, control_points, log_radii, transforms, near), stored
    )
    return _with_gradients(moved, (*_STORED_NAMES, "control_points", "radii", "transforms"), leaves)


def _displace(device: str, dtype: torch.dtype) -> Values:
    *stored, offsets, shift = _leaves(
        device, dtype, *_stored(), _random(_COUNT, 10), _random(_COUNT, 3, seed=1)
    )
    moved = _together(lambda splats: deformation.displace(splats, offsets, shift), stored)
    names = (*_STORED_NAMES, "deformations", "shifts")
    return _with_gradients(moved, names, [*stored, offsets, shift])


def _add_series(device: str, dtype: torch.dtype) -> Values:
    """Add three of five coefficients of three columns to the first of four."""
    shapes = (_COUNT, 4), (_COUNT, 5, 3), (_COUNT, 3)
    given = (_random(*shape, seed=seed) for seed, shape in enumerate(shapes))
    start, coefficients, basis = leaves = _leaves(device, dtype, *given)
    added = add_series(start, coefficients, basis, 1.3, 1)
    return _with_gradients(added, ("starts", "coefficients", "bases"), leaves)


def _light(device: str, dtype: torch.dtype) -> Values:
    shapes = (_COUNT, 4, 3), (_COUNT, 3, 3), (_COUNT, 4), (_COUNT, 4)
    given = (_random(*shape, seed=seed) for seed, shape in enumerate(shapes))
    sh, slopes, *quats = _leaves(device, dtype, *given)
    return _with_gradients(light(sh, slopes, *quats), ("harmonics", "slopes"), [sh, slopes])


def _share(device: str, dtype: torch.dtype) -> Values:
    return {"shares": hats([0.0, 0.3, 1.0], torch.zeros(_COUNT, device=device, dtype=dtype))}


def _slice(device: str, dtype: torch.dtype) -> Values:
    quats, log_scales, tilts = (_random(_COUNT, width, seed=width) for width in (4, 3, 4))
    leaves = _leaves(device, dtype, quats, log_scales, 1 + tilts, _random(_COUNT, seed=1))
    cut = slices(*leaves)
    side_by_side = [cut.variances[:, None], cut.velocities, cut.axes.flatten(1)]
    names = ("quaternions", "log scales", "tilts", "log durations")
    return _with_gradients(torch.cat(side_by_side, dim=1), names, leaves)


def _show_behind(device: str, dtype: torch.dtype) -> Values:
    """Show what lies behind a picture through five faces of a cube."""
    camera = Camera(np.eye(4), 5.0, 6.0, 9.0, 8.0, 18, 16)
    points = torch.arange(96).view(6, 4, 4)
    given = _random(16, 18, 3), _random(16, 18, seed=1).sigmoid(), _random(96, 3, seed=2)
    rgb, alpha, colours = leaves = _leaves(device, dtype, *given)
    shown = show_behind(rgb, alpha, colours, points.to(device), camera)
    return _with_gradients(shown, ("pictures", "alpha", "colours"), leaves)


def _apply_network(device: str, dtype: torch.dtype) -> Values:
    widths = [(48, 64), (64, 32), (32, 10)]
    tensors = [
        part
        for seed, (inputs, outputs) in enumerate(widths)
        for part in (_random(inputs, outputs, seed=seed) / inputs**0.5, _random(outputs, seed=7))
    ]
    leaves = _leaves(device, dtype, _random(_COUNT, 48, seed=8), *tensors)
    layers = [network.Layer(*pair) for pair in zip(leaves[1::2], leaves[2::2], strict=True)]
    names = ("inputs", *(f"{what} {i}" for i in range(3) for what in ("weights", "biases")))
    return _with_gradients(network.apply_network(layers, leaves[0]), names, leaves)


_BETA1, _BETA2, _EPS, _STEP, _INVERSE2 = 0.9, 0.999, 1e-8, 0.03, 250.0


def _make_steps(device: str, dtype: torch.dtype, gated: bool, loss: float = 1.0) -> Values:
    """Move 50 rows of three by Adam; those whose multiplier is 0 stay, moments included."""
    values, gradient, first = (_random(50, 3, seed=seed).to(device, dtype) for seed in range(3))
    second = _random(50, 3, seed=3).square().to(device, dtype)
    multipliers = torch.tensor([0.0, 0.01, 1.0])[torch.arange(50) % 3].to(device, dtype)
    trace = torch.zeros_like(values)
    if dtype is torch.float32:
        gates = (multipliers, trace) if gated else (None, None)
        row = Row(values, gradient, first, second, _STEP, _INVERSE2, *gates)
        adam([row], _BETA1, _BETA2, _EPS, torch.full((), loss, device=device))
    elif torch.tensor(loss).isfinite():
        factors = multipliers[:, None] if gated else torch.ones_like(multipliers)[:, None]
        m = _BETA1 * first + (1 - _BETA1) * gradient
        v = _BETA2 * second + (1 - _BETA2) * gradient.square()
        move = _STEP * m / ((v * _INVERSE2).sqrt() + _EPS)
        trace = move if gated else trace
        values = values - factors * move
        first, second = torch.where(factors > 0, m, first), torch.where(factors > 0, v, second)
    return {"values": values, "first moments": first, "second moments": second, "traces": trace}


_HALVES = {"bf16": torch.bfloat16, "fp16": torch.float16}

OPERATIONS = {
    "reading plane grids": _Operation(_look_up, FLOAT32),
    # a product of six samples, each rounded by half an eps at most
    **{
        f"reading plane grids in {name}": _Operation(_look_up, 4 * torch.finfo(dtype).eps, name)
        for name, dtype in _HALVES.items()
    },
    "the penalty of plane grids": _Operation(_penalise, FLOAT32),
    "reading hash grids": _Operation(_look_up_hashed, FLOAT32),
    "the search for the nearest control points": _Operation(_find_nearest, 0.0),
    "the transforms of control points": _Operation(_transform, FLOAT32),
    "skinning splats": _Operation(_skin, FLOAT32),
    "displacing splats": _Operation(_displace, FLOAT32),
    "adding series": _Operation(_add_series, FLOAT32),
    "colours of splats that have turned": _Operation(_light, FLOAT32),
    "shares of nodes in time": _Operation(_share, FLOAT32),
    "slices of Gaussians in time": _Operation(_slice, FLOAT32),
    "colours behind splats": _Operation(_show_behind, FLOAT32),
    "a network": _Operation(_apply_network, FLOAT32),
    # gradients are bfloat16 in either format, and some units near 0 are cut off on the other side
    **{
        f"a network in {name}": _Operation(
            _apply_network, 16 * torch.finfo(torch.bfloat16).eps, name
        )
        for name in _HALVES
    },
    "Adam": _Operation(partial(_make_steps, gated=False), FLOAT32),
    "Adam with multipliers": _Operation(partial(_make_steps, gated=True), FLOAT32),
    "Adam with a loss that is not finite": _Operation(
        partial(_make_steps, gated=True, loss=float("nan")), 0.0
    ),
}
"""By name all operations of a training step but drawing and comparing."""
