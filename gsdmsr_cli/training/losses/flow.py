"""What splats move on the screen between two moments, held to the optical flow of the pictures.

Katsumata, Vo, Nakayama (ECCV 2024, section 3.4), with the flow of OpenCV in place of a network's.
The motion of the splats' centres on the screen is drawn as colours are, with the splats themselves
taken for constant, and compared with the flow of the pictures where that is the same there and
back. Only views whose camera has a picture of the moment before or after have a part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from gsdmsr_cli.drawing.flow import blend_motion, screen_motion
from gsdmsr_cli.options.strict import require, require_progress
from gsdmsr_cli.raster import Engine
from gsdmsr_cli.runs.outputs import FLOW
from gsdmsr_cli.scene.neighbours import LEAST_SHARE, neighbours
from gsdmsr_cli.scene.pictured_flow import PicturedFlow
from gsdmsr_cli.scene.scene import View
from gsdmsr_cli.training.losses import Seen, Term
from gsdmsr_cli.training.losses._comparing import nothing

LEAST_COVER = 0.5
"""Pixels count where the splats cover this much or more."""


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        factor: weight of the mean error, which is in units of the longer side of the picture.
        since: progress from which it counts.
        until: progress up to which it counts.
    """

    factor: float = 1.0
    since: float = 0.1
    until: float = 1.0

    def __post_init__(self) -> None:
        require(self, "factor", self.factor > 0, "a number above 0")
        require_progress(self, "since")
        within = self.since < self.until <= 1
        require(self, "until", within, f"a progress above since, which is {self.since:g}, up to 1")


class Flow(Term):
    """The mean distance, in both coordinates, of the drawn flow from that of the pictures."""

    def __init__(self, options: Options) -> None:
        self.options = options
        self._beside: dict[View, tuple[View, ...]] = {}
        self._pictured = PicturedFlow()
        self._engine: Engine | None = None

    def begin(self, views: Sequence[View], engine: Engine) -> str | None:
        """Find out which views are neighbours; say so if there are hardly any."""
        self._engine, self._beside = engine, neighbours(views)
        having = sum(bool(beside) for beside in self._beside.values())
        if having >= LEAST_SHARE * len(views) and having > 0:
            return None
        self._beside = {}
        return (
            f"the term flow of the loss is left out: {having} of {len(views)} train views have a "
            "neighbour, a view of the moment before or after by the same camera"
        )

    def cache_in(self, folder: Path) -> None:
        """Keep flow in a folder of the run's."""
        self._pictured.folder = folder / FLOW

    def weight(self, progress: float) -> float:
        """Return the factor while the term counts, 0 where no views are neighbours."""
        o = self.options
        return o.factor if self._beside and o.since <= progress < o.until else 0.0

    def other_time(
        self, view: View, times: Sequence[float], generator: torch.Generator
    ) -> float | None:
        """Return the time of the neighbour before or after, whichever chance says."""
        beside = self._beside.get(view, ())
        if not beside:
            return None
        return beside[int(torch.randint(len(beside), (), generator=generator))].time

    def __call__(self, seen: Seen) -> Tensor:
        """Return the mean error () over the pixels that count [longer sides of the picture]."""
        then = None if seen.other_instant is None else seen.other_instant.time
        other = next((v for v in self._beside.get(seen.view, ()) if v.time == then), None)
        if other is None or seen.other is None or self._engine is None:
            return nothing(seen)
        found = self._pictured.between(seen.pictures, seen.view, other)
        moved = screen_motion(seen.moment, seen.camera, seen.other, seen.camera_of(other))
        drawn, alpha = blend_motion(moved, seen.moment.detach(), seen.camera, self._engine)
        true = torch.from_numpy(found).to(drawn.device)
        counts = true.isfinite().all(dim=2) & (alpha.detach() >= LEAST_COVER)
        counted = seen.counted()
        if counted is not None:
            counts &= counted
        errors = (drawn - true.nan_to_num()).abs().sum(dim=2) * counts
        longer = max(seen.camera.width, seen.camera.height)
        return errors.sum() / (counts.sum().clamp(min=1) * longer)


def start(options: Options) -> Flow:
    """Return the term."""
    return Flow(options)
