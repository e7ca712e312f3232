"""What layers share that hold a row of numbers for each view, or each fixed camera, of a capture.

Of these numbers their mean is taken away where they are used: what all views have in common belongs
to the splats.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.model.layer import Instant, Layer
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.model.view_rows import Per, ViewRows, Weights, rows_of
from gsdmsr_cli.scene.camera import Camera


class PerView(Layer):
    """Trained numbers ``values`` (rows, ...), with the views that they belong to as buffers.

    Args:
        per: what has a row.
        shape: of a row.
        rate: learning rate, [start, end].
        weight: of the mean square of the numbers.
        since: progress from which they are learnt.
        bound: of the scene [world units].
        more: parameters of the layer beside those of all such layers.

    Attributes:
        beside: see ``ViewRows``.
    """

    beside: ClassVar[int] = 1
    concerns_still = True
    holds_views = True

    def __init__(
        self,
        per: Per,
        shape: Sequence[int],
        rate: tuple[float, float],
        weight: float,
        since: float,
        bound: float,
        more: Sequence[Parameter] = (),
    ) -> None:
        self.per, self.weight, self.since, self.bound = per, weight, since, bound
        self.values = torch.zeros(0, *shape)
        self.times = torch.zeros(0, dtype=torch.float64)
        self.poses = torch.zeros(0, 4, 4, dtype=torch.float64)
        self.numbers = torch.zeros(0, dtype=torch.int64)
        self.learning = False
        self._rows: ViewRows | None = None
        names = "times", "poses", "numbers"
        named = [Parameter(name, t) for name, t in zip(names, self._tables(), strict=True)]
        super().__init__([Parameter("values", self.values, rate=rate), *named, *more])

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the moment itself."""
        return moment

    def advance(self, progress: float) -> None:
        """Learn once it is time."""
        self.learning = progress >= self.since

    def begin_with(self, views: Sequence[tuple[Camera, float]]) -> None:
        """Hold a row of zeros for each view, or each fixed camera."""
        rows = rows_of(views, self.per, self.bound, self.beside)
        values, times, poses, numbers, *_ = self.parameters()
        values.set_values(self.values.new_zeros(rows.count, *self.values.shape[1:]))
        times.set_values(torch.from_numpy(rows.times))
        poses.set_values(torch.from_numpy(rows.poses))
        numbers.set_values(torch.from_numpy(rows.rows))
        self._rows = rows

    @property
    def rows(self) -> ViewRows:
        """Which row belongs to which view."""
        if self._rows is None:
            times, poses, numbers = (t.cpu().numpy() for t in self._tables())
            self._rows = ViewRows(times, poses, numbers, self.bound, self.beside)
        return self._rows

    def _tables(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.times, self.poses, self.numbers

    def check(self) -> None:
        """Raise ValueError unless every view has a row, and every row a view."""
        views, self._rows = len(self.times), None
        ok = self.poses.shape == (views, 4, 4) and self.numbers.shape == (views,)
        used = self.numbers.unique() if ok else self.numbers
        if not ok or not torch.equal(used, torch.arange(len(self.values)).to(used)):
            raise ValueError(f"rows of {len(self.values)} that do not fit to {views} views")

    def weighed(self, values: Tensor, view: Camera | None, time: float) -> Tensor | None:
        """Return the row (...) of a view in values (rows, ...), or None if it has none."""
        weights: Weights = () if view is None else self.rows.weights(view, time)
        if not weights:
            return None
        parts = [values[row] if share == 1 else share * values[row] for row, share in weights]
        return sum(parts[1:], parts[0])

    def penalty(
        self, moment: Moment, instant: Instant, generator: torch.Generator
    ) -> Tensor | None:
        """Return the weighted mean square of the numbers, the squares of a row added up."""
        if not self.learning or not len(self.values):
            return None
        return self.weight * self.values.square().sum() / len(self.values)

    def tell_views(self, views: Sequence[tuple[Camera, float]]) -> dict[str, Any]:
        """Return how many of the views have a row of their own, those of neighbours, or none."""
        own = sum(self.rows.own(*view) is not None for view in views)
        none = sum(not self.rows.weights(*view) for view in views)
        per = "fixed camera" if self.rows.per_camera else "picture"
        return {"per": per, "own": own, "of_neighbours": len(views) - own - none, "none": none}
