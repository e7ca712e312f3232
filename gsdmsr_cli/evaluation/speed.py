"""Measures how many frames a second a model renders, with and without its motion."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from gsdmsr_cli.drawing.splatting import draw, draw_shown, show
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.raster import Engine
from gsdmsr_cli.scene.camera import Camera

WARM_UP = 3
"""Frames drawn before the clock starts."""

SECONDS = 1.0
"""Least time measured."""

SHOTS = 16
"""Most cameras that are drawn in turn; their moved splats are kept in memory."""


@dataclass(frozen=True)
class Speed:
    """Frames a second.

    Attributes:
        fps: moving the splats and drawing them.
        fps_raster: drawing splats that have been moved before.
        frames: number of frames timed for ``fps``.
    """

    fps: float
    fps_raster: float
    frames: int

    def document(self) -> dict[str, Any]:
        """Return the numbers for a report."""
        return asdict(self) | {"warm_up_frames": WARM_UP}


@torch.no_grad()
def measure_speed(
    model: Model, shots: Sequence[tuple[Camera, float]], engine: Engine, background: Tensor
) -> Speed:
    """Draw some of the (camera, time) in ``shots``, over again until a second has passed."""
    chosen = shots[:: -(-len(shots) // SHOTS)]
    cameras = [camera for camera, _ in chosen]

    def move(i: int) -> object:
        return draw(model, cameras[i], chosen[i][1], engine, background)

    def wait() -> None:
        if background.is_cuda:
            torch.cuda.synchronize()

    fps, frames = _rate(move, len(chosen), wait)
    moved = [show(model, model.instant(time, camera)) for camera, time in chosen]

    def rasterize(i: int) -> object:
        return draw_shown(moved[i], cameras[i], engine, background)

    fps_raster, _ = _rate(rasterize, len(chosen), wait)
    return Speed(fps, fps_raster, frames)


def _rate(
    draw: Callable[[int], object], count: int, wait: Callable[[], object]
) -> tuple[float, int]:
    """Call ``draw`` with 0 to count - 1 in turn; return the calls a second and how many.

    What has been drawn is there when ``wait`` returns.
    """
    for i in range(WARM_UP):
        draw(i % count)
    wait()
    started, frames = time.perf_counter(), 0
    while frames < count or time.perf_counter() - started < SECONDS:
        draw(frames % count)
        frames += 1
    wait()
    return frames / (time.perf_counter() - started), frames
