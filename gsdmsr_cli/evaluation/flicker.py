"""Measures flicker: how much consecutive pictures differ where they show the same thing.

Of two consecutive pictures the later one is warped to the earlier one by the optical flow of the
true ones, as in the warping error of Lai et al. (ECCV 2018). The true pictures have some of it as
well, from noise, light that changes and flow that is not exact, so their own stands beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsdmsr_cli.evaluation.metrics import Missing
from gsdmsr_cli.evaluation.protocol import ViewRenderer
from gsdmsr_cli.scene.native import cv2
from gsdmsr_cli.scene.neighbours import LEAST_SHARE, neighbours
from gsdmsr_cli.scene.optical_flow import Floats32, ends_of
from gsdmsr_cli.scene.pictured_flow import SMALLEST, PicturedFlow
from gsdmsr_cli.scene.scene import MASK, View

Pair = tuple[View, View]
"""Two consecutive views, the earlier one first."""


@dataclass(frozen=True)
class Flicker:
    """Flicker of some pairs of pictures, the means over the pairs.

    Attributes:
        drawn: of the drawn pictures, NaN where one of them holds NaN.
        true: of the true ones.
        pairs: how many have pixels that count.
        pixels: the share of their pixels that count.
    """

    drawn: float
    true: float
    pairs: int
    pixels: float


def consecutive(views: Sequence[View], scene: Sequence[View]) -> list[Pair] | Missing:
    """Return the views of a split with their neighbours before and after, each pair once.

    A pair begins where the one before it ended, wherever there is such a one.

    Args:
        views: of the split.
        scene: all views, among which there may be neighbours.
    """
    beside = neighbours(scene, views)
    having = sum(bool(others) for others in beside.values())
    if not having or having < LEAST_SHARE * len(views):
        return Missing(
            f"{having} of {len(views)} views have a neighbour: one of the moment before or after, "
            "by the same camera or one that has hardly moved", (),
        )  # fmt: skip
    found = {
        (view, other) if view.time < other.time else (other, view)
        for view in views
        for other in beside[view]
    }
    return _in_turn(sorted(found, key=lambda pair: (pair[0].time, pair[0].name, pair[1].name)))


def _in_turn(pairs: Sequence[Pair]) -> list[Pair]:
    """Return the pairs such that each goes on from the one before it, where one does."""
    left, ordered = dict.fromkeys(pairs), list[Pair]()
    begins: dict[View, list[Pair]] = {}
    for pair in pairs:
        begins.setdefault(pair[0], []).append(pair)
    for first in pairs:
        following = [first] if first in left else []
        while following:
            ordered.append(following[0])
            del left[following[0]]
            following = [pair for pair in begins.get(following[0][1], ()) if pair in left]
    return ordered


def measure_flicker(
    renderer: ViewRenderer, pairs: Sequence[Pair], on_progress: Callable[[int], None]
) -> Flicker | Missing:
    """Return the flicker of the pairs; of three views at most there are pictures in memory.

    Args:
        renderer: draws the views.
        pairs: of ``consecutive``.
        on_progress: called with how many pairs are done.

    Raises:
        DataError: a picture or a mask cannot be read.
    """
    flow = PicturedFlow()
    held: dict[View, tuple[Floats32, Floats32]] = {}
    drawn, true, shares = [], [], []
    for done, (one, other) in enumerate(pairs, start=1):
        here, after = (held.get(view) or _pictures(renderer, view) for view in (one, other))
        held = {one: here, other: after}
        there = flow.between(renderer.pictures, one, other)
        counts = _counted(renderer, one, there)
        if counts.any():
            drawn.append(_difference(here[0], after[0], there, counts))
            true.append(_difference(here[1], after[1], there, counts))
            shares.append(float(counts.mean()))
        on_progress(done)
    if drawn:
        return Flicker(fmean(drawn), fmean(true), len(drawn), fmean(shares))
    camera = renderer.pictures.camera(pairs[0][0])
    if min(camera.width, camera.height) < SMALLEST:
        size = f"{camera.width} x {camera.height} px"
        return Missing(f"pictures of {size}; optical flow needs {SMALLEST} px a side", ())
    return Missing("no pixel counts whose optical flow there and back agrees", ())


def _pictures(renderer: ViewRenderer, view: View) -> tuple[Floats32, Floats32]:
    """Return the drawn and the true picture, (H, W, 3) in [0, 1]."""
    return renderer.draw(view).clamp(0, 1).numpy(), renderer.true(view).numpy()


def _counted(renderer: ViewRenderer, view: View, flow: Floats32) -> NDArray[np.bool_]:
    """Return the pixels (H, W) with a flow that the view's mask counts, if it has one."""
    known = torch.from_numpy(flow).isfinite().all(dim=2)
    mask = renderer.pictures.signal(view, MASK)
    return np.asarray(known if mask is None else known & mask, dtype=np.bool_)


def _difference(
    here: Floats32, there: Floats32, flow: Floats32, counts: NDArray[np.bool_]
) -> float:
    """Return the mean of |here(p) - there(p + flow(p))| over the pixels that count and channels."""
    ends = ends_of(np.where(counts[..., None], flow, np.float32(0)))
    warped = cv2.remap(there, *ends, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return float(np.abs(here - warped)[counts].mean(dtype=np.float64))


def figures(found: Flicker | Missing) -> Mapping[str, Any]:
    """Return the metrics of an aggregate; without a value ``flicker`` alone, with the reason."""
    if isinstance(found, Missing):
        return {"flicker": _entry(None, found.reason)}
    if not np.isfinite(found.drawn):
        return {"flicker": _entry(None, "not a number in at least one frame")}
    values = {
        "flicker": found.drawn, "flicker_true": found.true,
        "flicker_excess": found.drawn - found.true,
    }  # fmt: skip
    return {name: _entry(value, None) for name, value in values.items()}


def _entry(value: float | None, reason: str | None) -> dict[str, Any]:
    return {"value": value, "reason": reason, "searched": []}
