"""Splats for tests of exports, and how a test exports them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from motion_checks import model_of
from numpy.typing import NDArray
from torch import Tensor

from gsdmsr_cli.exports import Written, export
from gsdmsr_cli.exports._facts import Facts
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Instant, Layer
from gsdmsr_cli.options.strict import Located

Array = NDArray[Any]
FACTS: Facts = SimpleNamespace(bound=1.0, frames=3)


def usual_splats(count: int, degree: int, seed: int = 0) -> Splats:
    """Return splats as trainings give them: formats of few bits hold only values of such sizes."""
    source = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(count, *shape, generator=source)

    harmonics = [normal(1, 3).clamp(-3, 3), 0.15 * normal((degree + 1) ** 2 - 1, 3).clamp(-3, 3)]
    return Splats(
        means=normal(3),
        quats=3 * normal(4),
        log_scales=normal(3) - 4,
        logit_opacities=2 * normal(),
        sh=torch.cat(harmonics, dim=1),
    )


class Falling(Layer):
    """Splats that fall by one unit; their moments have what else is given."""

    def __init__(self, **beside: Tensor) -> None:
        super().__init__()
        self.beside = beside

    def at(self, moment: Moment, instant: Instant) -> Moment:
        way = torch.tensor([0.0, instant.time, 0.0])
        return Moment(replace(moment.splats, means=moment.splats.means + way), **self.beside)


def write(kind: str, splats: Splats, out: Path, beside: Any = None, **settings: Any) -> Written:
    """Export splats that fall, with ``beside`` besides them."""
    model = model_of(splats, Falling(**(beside or {})))
    return export(kind, model, FACTS, Located(settings), out)


def unit(quats: Tensor) -> Array:
    """Return unit quaternions, float64."""
    wide = quats.double()
    return np.asarray((wide / wide.norm(dim=1, keepdim=True)).numpy())


def angles(first: Array, second: Array) -> Array:
    """Return by which angles [rad] two rows of quaternions differ, whatever their sign."""
    first = first / np.linalg.norm(first, axis=1, keepdims=True)
    second = second / np.linalg.norm(second, axis=1, keepdims=True)
    chord = np.minimum(
        np.linalg.norm(first - second, axis=1), np.linalg.norm(first + second, axis=1)
    )
    return np.asarray(4 * np.arcsin(np.clip(chord / 2, 0, 1)))


def sigmoid(values: Tensor) -> Array:
    return np.asarray(values.double().sigmoid().numpy())
