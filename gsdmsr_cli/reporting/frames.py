"""Renders the worst and the best frames as pictures embedded in the HTML page."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.evaluation.metrics import quantize
from gsdmsr_cli.evaluation.protocol import ViewRenderer
from gsdmsr_cli.filming.outputs import error_colours
from gsdmsr_cli.scene.imaging import eight_bits, encode_webp, resize_area
from gsdmsr_cli.scene.scene import View

SHOWN = 4
"""At most so many of the worst frames, and so many of the best."""

SIDE, THUMBNAIL = 800, 96
"""Longest side of a picture, and of the small one that stands for it [px]."""

SCALES = (0.02, 0.05, 0.1, 0.25, 0.5, 1.0)
"""Where the colours of errors may end; the least that nearly all errors stay below is taken."""

_QUALITY, _THUMBNAIL_QUALITY = 92, 80
_NEARLY_ALL = 99.5

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class ReportFrame:
    """A frame as a page shows it; all pictures are URLs that hold their data.

    Attributes:
        index: of the frame in the report.
        worst: whether it is one of the worst, else it is one of the best.
        width: of the pictures [px].
        height: of the pictures [px].
        true: the true picture.
        drawn: the drawn one.
        error: how far they are apart, as colours.
        thumbnail: the drawn one, small.
    """

    index: int
    worst: bool
    width: int
    height: int
    true: str
    drawn: str
    error: str
    thumbnail: str


def choose(frames: Sequence[Mapping[str, Any]]) -> tuple[list[int], list[int]]:
    """Return the indices of the worst frames, worst first, and of the best, best first.

    Frames without a PSNR are the worst of all. No frame is both.
    """
    order = sorted(range(len(frames)), key=lambda i: _psnr(frames[i]))
    count = min(SHOWN, (len(order) + 1) // 2)
    return order[:count], order[: count - 1 : -1][: min(SHOWN, len(order) - count)]


def _psnr(frame: Mapping[str, Any]) -> float:
    value = frame["psnr"]
    return float("-inf") if value is None else float(value)


def make_report_frames(
    renderer: ViewRenderer, views: Sequence[View], frames: Sequence[Mapping[str, Any]]
) -> tuple[list[ReportFrame], float]:
    """Draw the worst and the best frames; return them and where the errors' colours end.

    Args:
        renderer: draws them.
        views: all views of the report.
        frames: their scores, in the same order.
    """
    worst, best = choose(frames)
    pairs = {i: drawn_and_true(renderer, views[i]) for i in (*worst, *best)}
    full = scale_of(np.abs(drawn - true).mean(2) for drawn, true in pairs.values())
    shown = [_report_frame(i, i in worst, *pairs[i], full) for i in (*worst, *best)]
    return shown, full


def scale_of(errors: Iterable[Floats]) -> float:
    """Return the least scale that nearly all of the (H, W) errors stay below."""
    reach = max(float(np.percentile(error, _NEARLY_ALL)) for error in errors)
    return next((scale for scale in SCALES if scale >= reach), SCALES[-1])


def drawn_and_true(renderer: ViewRenderer, view: View) -> tuple[Floats, Floats]:
    """Return the drawn and the true picture, (H, W, 3) in [0, 1], no longer than SIDE."""
    drawn, true = quantize(renderer.draw(view)), renderer.true(view)
    return _fitted(drawn.numpy(force=True), SIDE), _fitted(true.numpy(force=True), SIDE)


def _fitted(picture: Floats, side: int) -> Floats:
    height, width, _ = picture.shape
    scale = side / max(height, width)
    if scale >= 1:
        return picture
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return resize_area(np.ascontiguousarray(picture), *size)


def _report_frame(index: int, worst: bool, drawn: Floats, true: Floats, full: float) -> ReportFrame:
    height, width, _ = drawn.shape
    return ReportFrame(
        index,
        worst,
        width,
        height,
        true=data_url(eight_bits(true)),
        drawn=data_url(eight_bits(drawn)),
        error=data_url(error_colours(eight_bits(drawn), true, full)),
        thumbnail=data_url(eight_bits(_fitted(drawn, THUMBNAIL)), _THUMBNAIL_QUALITY),
    )


def data_url(pixels: NDArray[np.uint8], quality: int = _QUALITY) -> str:
    """Return (H, W, 3) pixels as a URL that holds them, as WebP of a quality from 1 to 100."""
    encoded = base64.b64encode(encode_webp(pixels, quality)).decode("ascii")
    return f"data:image/webp;base64,{encoded}"
