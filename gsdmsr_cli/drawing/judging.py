"""How much worse the pictures of another model are than those of one that it stands for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsdmsr_cli.drawing.splatting import draw
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.raster import Engine
from gsdmsr_cli.scene.camera import Camera

ASSUMED = 1e-4
"""Mean squared error that the pictures of the model have where the truth is not known: 40 dB."""

LEAST_ERROR = 1e-9
"""Mean squared errors count as this much at least: a model may be its own truth."""


@dataclass(frozen=True)
class Loss:
    """What the other model loses, in dB of PSNR, the mean over the views.

    Attributes:
        measured: PSNR of the one less that of the other, against the pictures; may be negative.
        expected: what it would be if the differences had nothing to do with the model's errors. It
            is 0 or more, and grows with the differences.
    """

    measured: float
    expected: float


class Judge:
    """Compares models with one, in a few views."""

    def __init__(
        self,
        model: Model,
        shots: Sequence[tuple[Camera, float]],
        pictures: Sequence[Tensor] | None,
        engine: Engine,
        background: Tensor,
    ) -> None:
        """Draw the model.

        Args:
            model: that others stand for.
            shots: one or more cameras and times.
            pictures: the truth, (3, H, W) uint8 each, or None if it is not known.
            engine: what draws.
            background: (3,) colour behind the splats.
        """
        self._shots, self._engine, self._background = shots, engine, background
        self._pictures = pictures
        self._drawn = [self._draw(model, *shot) for shot in shots]
        self._errors = [self._error(place, drawn) for place, drawn in enumerate(self._drawn)]

    @property
    def knows_truth(self) -> bool:
        """Whether there are pictures to compare with."""
        return self._pictures is not None

    @property
    def psnr(self) -> float | None:
        """Of the model that others stand for, the mean over the views; None without pictures."""
        if self._pictures is None:
            return None
        return sum(-10 * math.log10(error) for error in self._errors) / len(self._errors)

    def loss(self, model: Model) -> Loss:
        """Return what another model loses."""
        measured, expected = [], []
        for place, shot in enumerate(self._shots):
            drawn = self._draw(model, *shot)
            apart = _mean_square(drawn - self._drawn[place]) / self._errors[place]
            expected.append(10 * math.log10(1 + apart))
            error = self._error(place, drawn) / self._errors[place]
            measured.append(10 * math.log10(error) if self.knows_truth else expected[-1])
        return Loss(sum(measured) / len(measured), sum(expected) / len(expected))

    @torch.no_grad()
    def _draw(self, model: Model, camera: Camera, time: float) -> Tensor:
        drawn = draw(model, camera, time, self._engine, self._background).rgb
        return drawn.clamp(0, 1)

    def _error(self, place: int, drawn: Tensor) -> float:
        if self._pictures is None:
            return ASSUMED
        truth = self._pictures[place].permute(1, 2, 0).to(drawn) / 255
        return max(_mean_square(drawn - truth), LEAST_ERROR)


def _mean_square(difference: Tensor) -> float:
    return float(difference.square().mean())
