"""Renders views of a trained model and scores them against the true pictures."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from gsdmsr_cli.drawing.splatting import draw
from gsdmsr_cli.evaluation.catalogue import Metric
from gsdmsr_cli.evaluation.metrics import (
    PSNR_CAP,
    Missing,
    mean_of,
    psnr,
    psnr_fitted,
    quantize,
    similarity,
)
from gsdmsr_cli.model.joined import own_name
from gsdmsr_cli.model.model import FURTHER, MOTION, STORED_AS, Model
from gsdmsr_cli.raster import Engine
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import MASK, MOVING, View

CONVENTIONS = {
    "renders": "clamped to [0, 1] and rounded to 8 bits; psnr_float is of unrounded ones",
    "sizes": "views of other sizes than in training look as those of training, with the low-pass "
    "of its pixels; smaller ones are drawn as finely as there and averaged",
    "psnr": f"of the mean squared error over all pixels and channels, at most {PSNR_CAP:g} dB",
    "psnr_fitted": "after the affine transform of the drawn colours that is best for the picture",
    "ssim": "11 x 11 Gaussian window of sigma 1.5 px, zero padding, mean over all pixels",
    "ms_ssim": "five scales with that window, only the last padded (mirrored), as in torchmetrics",
    "lpips": "v0.1, pictures mapped to [-1, 1]; those named _inria on [0, 1]",
    "parts": "psnr and ssim of the pixels that masks choose, over frames that have such pixels",
    "flicker": "mean difference of a picture, unrounded, in [0, 1], from the next one warped by "
    "the true pictures' optical flow, over pixels whose flow there and back agrees",
    "aggregate": "mean over frames",
}
"""What the numbers mean, as written into every report."""

Scores = dict[str, float | None]
"""Metric to value, None where there is no number."""


@dataclass(frozen=True, eq=False)
class ViewRenderer:
    """Renders views of a model and loads their true pictures.

    Attributes:
        model: what is drawn.
        engine: what draws it.
        pictures: the true pictures; they fix the size.
        background: (3,) colour behind the splats.
    """

    model: Model
    engine: Engine
    pictures: Pictures
    background: Tensor

    @torch.no_grad()
    def draw(self, view: View) -> Tensor:
        """Return the drawn picture, (H, W, 3), unclamped, in the memory of the CPU."""
        camera = self.pictures.camera(view)
        given = self.model, camera, view.time, self.engine, self.background
        return draw(*given, of_capture=True).rgb.cpu()

    def true(self, view: View) -> Tensor:
        """Return the true picture, (H, W, 3) in [0, 1].

        Raises:
            DataError: the file cannot be read.
        """
        return self.pictures.load(view).permute(1, 2, 0).float() / 255

    def over(self, background: tuple[float, float, float]) -> ViewRenderer:
        """Return the renderer with another background, behind drawn and true pictures alike."""
        pictures, colour = self.pictures.over(background), self.background.new_tensor(background)
        return replace(self, pictures=pictures, background=colour)

    def parts(self, view: View) -> dict[str, Tensor]:
        """Return the parts of the view's picture that it has masks for, (H, W) bools each.

        "masked" are the pixels that count, "moving" and "static" those of them where the scene
        moves and where it does not.

        Raises:
            DataError: a mask cannot be read.
        """
        counted = self.pictures.signal(view, MASK)
        moving = self.pictures.signal(view, MOVING)
        parts = {} if counted is None else {"masked": counted}
        if moving is not None:
            within = torch.ones_like(moving) if counted is None else counted
            parts |= {"moving": within & moving, "static": within & ~moving}
        return parts


def score_views(
    renderer: ViewRenderer,
    views: Iterable[View],
    metrics: Mapping[str, Metric | Missing] | None,
    on_progress: Callable[[int], None],
) -> list[tuple[View, Scores]]:
    """Return the scores of every view; ``on_progress`` is called with how many are done.

    Args:
        renderer: draws them.
        views: to be scored.
        metrics: as for ``score``; with None there is nothing but PSNR.
        on_progress: see above.

    Raises:
        DataError: a picture cannot be read.
    """
    scored = []
    for done, view in enumerate(views, start=1):
        drawn, true = renderer.draw(view), renderer.true(view)
        if metrics is None:
            scores: Scores = {"psnr": _finite(psnr(quantize(drawn), true))}
        else:
            scores = score(drawn, true, metrics, renderer.parts(view))
        scored.append((view, scores))
        on_progress(done)
    return scored


def score(
    drawn: Tensor,
    true: Tensor,
    metrics: Mapping[str, Metric | Missing],
    parts: Mapping[str, Tensor] | None = None,
) -> Scores:
    """Return all metrics of one picture (H, W, 3) against the true one.

    Args:
        drawn: the picture, unclamped.
        true: the true one, in [0, 1].
        metrics: which to compute beside PSNR and SSIM.
        parts: (H, W) bools by their names, whose PSNR and SSIM are wanted too; those without a
            pixel are left out.
    """
    rounded = quantize(drawn)
    similar = similarity(rounded, true)
    values: dict[str, float] = {
        "psnr": psnr(rounded, true),
        "psnr_float": psnr(drawn.clamp(0, 1), true),
        "psnr_fitted": psnr_fitted(rounded, true),
        "ssim": mean_of(similar, None),
    }
    for name, metric in metrics.items():
        values[name] = math.nan if isinstance(metric, Missing) else metric(rounded, true)
    for part, where in (parts or {}).items():
        if where.any():
            values[f"psnr_{part}"] = psnr(rounded, true, where)
            values[f"ssim_{part}"] = mean_of(similar, where)
    return {name: _finite(value) for name, value in values.items()}


def _finite(value: float) -> float | None:
    """Return the number for JSON, which has neither NaN nor infinity."""
    return None if math.isnan(value) else min(value, PSNR_CAP)


def average(scores: Sequence[Scores]) -> Scores:
    """Return the mean of every metric over the frames that name it, None if any has no number."""
    names = dict.fromkeys(name for frame in scores for name in frame)
    return {name: _mean([frame[name] for frame in scores if name in frame]) for name in names}


def _mean(values: Sequence[float | None]) -> float | None:
    numbers = [value for value in values if value is not None]
    return fmean(numbers) if len(numbers) == len(values) else None


def with_reasons(aggregate: Scores, metrics: Mapping[str, Metric | Missing]) -> dict[str, Any]:
    """Return the aggregate for a report, with the reason where such a metric has no value."""
    return aggregate | {name: _explained(aggregate[name], m) for name, m in metrics.items()}


def _explained(value: float | None, metric: Metric | Missing) -> dict[str, Any]:
    if isinstance(metric, Missing):
        return {"value": None, "reason": metric.reason, "searched": list(metric.searched)}
    reason = None if value is not None else "not a number in at least one frame"
    return {"value": value, "reason": reason, "searched": []}


def storage(stored: Mapping[str, int]) -> dict[str, int]:
    """Return the bytes of a checkpoint by parts: splats, motion, and what training adds.

    Args:
        stored: bytes of each tensor by its name, as ``Checkpoint.sizes`` has them.
    """
    sizes = {"splats_bytes": 0, "motion_bytes": 0, "training_state_bytes": 0}
    for stored_name, count in stored.items():
        name = own_name(stored_name)
        splats, moved = name.startswith(STORED_AS), name.startswith((f"{MOTION}.", FURTHER))
        kind = "splats" if splats else "motion" if moved else "training_state"
        sizes[f"{kind}_bytes"] += count
    return sizes
