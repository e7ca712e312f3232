"""Compares a model's pictures with the true ones: per frame, on average, and how it was done."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from gsdmsr_cli.evaluation.lpips import NETS, Lpips, Missing, load_lpips
from gsdmsr_cli.evaluation.metrics import PSNR_CAP, psnr, quantize, ssim
from gsdmsr_cli.model import MOVED_BY, STORED_AS, Model
from gsdmsr_cli.pictures import Pictures
from gsdmsr_cli.raster import Engine
from gsdmsr_cli.scene import View
from gsdmsr_cli.splatting import draw

CONVENTIONS = {
    "renders": "clamped to [0, 1] and rounded to 8 bits; psnr_float is of unrounded ones",
    "psnr": f"of the mean squared error over all pixels and channels, at most {PSNR_CAP:g} dB",
    "ssim": "11 x 11 Gaussian window of sigma 1.5 px, zero padding, mean over all pixels",
    "lpips": "v0.1, pictures mapped to [-1, 1]",
    "aggregate": "mean over frames",
}
"""What the numbers mean, as written into every report."""

Scores = dict[str, float | None]
"""Metric to value, None where there is no number."""


@dataclass(frozen=True, eq=False)
class Studio:
    """All that turns a view into a drawn and a true picture.

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
        """Return the drawn picture, (H, W, 3), unclamped."""
        camera = self.pictures.camera(view)
        return draw(self.model, camera, view.time, self.engine, self.background).rgb

    def true(self, view: View) -> Tensor:
        """Return the true picture, (H, W, 3) in [0, 1].

        Raises:
            DataError: the file cannot be read.
        """
        return self.pictures.load(view).permute(1, 2, 0).float() / 255


def load_nets(size: tuple[int, int], **where: Any) -> dict[str, Lpips | Missing]:
    """Load LPIPS on every network, or the reason why there is none for pictures of this size.

    Args:
        size: width and height of the pictures [px].
        where: passed on to ``load_lpips``.
    """
    nets = {f"lpips_{net}": load_lpips(net, **where) for net in NETS}
    return {name: _fit(net, size) for name, net in nets.items()}


def _fit(net: Lpips | Missing, size: tuple[int, int]) -> Lpips | Missing:
    if isinstance(net, Missing) or min(size) >= net.smallest:
        return net
    reason = f"pictures of {size[0]} x {size[1]} px; '{net.net}' needs {net.smallest} px a side"
    return Missing(reason, ())


def score_views(
    studio: Studio,
    views: Iterable[View],
    nets: Mapping[str, Lpips | Missing],
    tell: Callable[[int], None],
) -> list[tuple[View, Scores]]:
    """Return the scores of every view; ``tell`` is called with how many are done.

    Raises:
        DataError: a picture cannot be read.
    """
    scored = []
    for done, view in enumerate(views, start=1):
        scored.append((view, score(studio.draw(view), studio.true(view), nets)))
        tell(done)
    return scored


def score(drawn: Tensor, true: Tensor, nets: Mapping[str, Lpips | Missing]) -> Scores:
    """Return all metrics of one picture (H, W, 3) against the true one."""
    rounded = quantize(drawn)
    values: dict[str, float] = {
        "psnr": psnr(rounded, true),
        "psnr_float": psnr(drawn.clamp(0, 1), true),
        "ssim": ssim(rounded, true),
    }
    for name, net in nets.items():
        values[name] = math.nan if isinstance(net, Missing) else net(rounded, true)
    return {name: _finite(value) for name, value in values.items()}


def _finite(value: float) -> float | None:
    """Return the number for JSON, which has neither NaN nor infinity."""
    return None if math.isnan(value) else min(value, PSNR_CAP)


def average(scores: Sequence[Scores]) -> Scores:
    """Return the mean of every metric, None if any frame lacks it."""
    columns = {name: [frame[name] for frame in scores] for name in scores[0]}
    return {name: _mean(values) for name, values in columns.items()}


def _mean(values: Sequence[float | None]) -> float | None:
    numbers = [value for value in values if value is not None]
    return fmean(numbers) if len(numbers) == len(values) else None


def with_reasons(aggregate: Scores, nets: Mapping[str, Lpips | Missing]) -> dict[str, Any]:
    """Return the aggregate for a report: every LPIPS with the reason where it has no value."""
    return aggregate | {name: _explained(aggregate[name], net) for name, net in nets.items()}


def _explained(value: float | None, net: Lpips | Missing) -> dict[str, Any]:
    if isinstance(net, Missing):
        return {"value": None, "reason": net.reason, "searched": list(net.searched)}
    reason = None if value is not None else "not a number in at least one frame"
    return {"value": value, "reason": reason, "searched": []}


def storage(tensors: Mapping[str, Tensor]) -> dict[str, int]:
    """Return the bytes of a checkpoint's tensors: splats, motion, and what training adds."""
    sizes = {"splats_bytes": 0, "motion_bytes": 0, "training_state_bytes": 0}
    for name, tensor in tensors.items():
        splats, moved = name.startswith(STORED_AS), name.startswith(MOVED_BY)
        kind = "splats" if splats else "motion" if moved else "training_state"
        sizes[f"{kind}_bytes"] += tensor.nbytes
    return sizes
