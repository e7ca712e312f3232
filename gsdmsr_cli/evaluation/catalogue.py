"""Lists all metrics: names, which direction is better, and which need large pictures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from torch import Tensor

from gsdmsr_cli.evaluation.lpips import NETS, Lpips, load_lpips
from gsdmsr_cli.evaluation.metrics import MS_SSIM_SMALLEST, Missing, ms_ssim

PARTS = ("masked", "moving", "static")
"""Parts of a picture: the pixels that count; of these, those where the scene moves; the others."""

PUBLISHED = ("alex", "vgg")
"""Networks whose LPIPS papers after 3DGS take on [0, 1]."""

_LPIPS = tuple(f"lpips_{net}" for net in NETS)
_LPIPS_INRIA = tuple(f"lpips_{net}_inria" for net in PUBLISHED)

WHOLE = ("psnr", "psnr_float", "psnr_fitted", "ssim", "ms_ssim", *_LPIPS, *_LPIPS_INRIA)
"""Metrics of whole pictures."""

FLICKER = ("flicker", "flicker_true", "flicker_excess")
"""Of consecutive pictures: of the drawn ones, of the true ones, and by how much it is more."""

OF_TRUTH = ("flicker_true",)
"""Metrics of the true pictures alone, beside which others are read; no run is better by them."""

METRICS = (
    *WHOLE,
    *FLICKER,
    *(f"{metric}_{part}" for part in PARTS for metric in ("psnr", "ssim")),
)
"""All metrics, in the order of tables."""

Metric = Callable[[Tensor, Tensor], float]
"""Takes the drawn and the true picture, (H, W, 3) in [0, 1]."""


def less_is_better(metric: str) -> bool:
    """Return whether the metric is a distance."""
    return metric.startswith("lpips_") or metric in FLICKER


def load_metrics(
    size: tuple[int, int], weights: Path | None = None, published: bool = False
) -> dict[str, Metric | Missing]:
    """Return the metrics that not every picture can have, or the reason why there is none.

    Args:
        size: width and height of the pictures [px].
        weights: folder of LPIPS weights, if not in the usual places.
        published: whether LPIPS on [0, 1] is wanted too, as ``lpips_vgg_inria``.

    Raises:
        DataError: ``weights`` is not a folder, or a file of weights is damaged.
    """
    large = min(size) >= MS_SSIM_SMALLEST
    metrics: dict[str, Metric | Missing] = {
        "ms_ssim": ms_ssim if large else _too_small(size, "MS-SSIM", MS_SSIM_SMALLEST)
    }
    nets = {net: _fit(load_lpips(net, weights), size) for net in NETS}
    metrics |= {f"lpips_{net}": lpips for net, lpips in nets.items()}
    if published:
        for net in PUBLISHED:
            lpips = nets[net]
            unscaled = lpips.unscaled if isinstance(lpips, Lpips) else lpips
            metrics[f"lpips_{net}_inria"] = unscaled
    return metrics


def _fit(lpips: Lpips | Missing, size: tuple[int, int]) -> Lpips | Missing:
    if isinstance(lpips, Missing) or min(size) >= lpips.smallest:
        return lpips
    return _too_small(size, f"'{lpips.net}'", lpips.smallest)


def _too_small(size: tuple[int, int], what: str, smallest: int) -> Missing:
    return Missing(f"pictures of {size[0]} x {size[1]} px; {what} needs {smallest} px a side", ())
