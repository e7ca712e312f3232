"""Chooses how coarsely each part is coded, so that a file of few bytes loses no more than allowed.

Rounding a part to steps s costs an error in proportion to s^2, and each halving of s some bytes.
The sum of all bytes is least where a byte buys the same everywhere: where the errors of the parts
are in proportion to the bytes that halving their steps costs (reverse water-filling).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.moving.baked import Baked
from gsdmsr_cli.moving.coding import CURVES, SHARES, coded, described, steps_named
from gsdmsr_cli.moving.decoding import decoded
from gsdmsr_cli.moving.parts import QUICKLY, Part, Table, packed

FINEST, COARSEST = -8, 6
"""Powers of two by which the steps of the start are multiplied at most."""

ALONE = 2.0**-4
"""Steps of all other parts are this much finer where one is tried alone."""

MOST_CHANGE = 8.0
"""A part's step changes by this factor at most where parts are weighed against one another."""

HALVINGS = 4
"""Of an octave, where the common factor of all steps is searched."""

LEAST_LOSS = 1e-7
"""Parts that seem to lose less count as losing this much [dB]."""


class Lost(Protocol):
    """What a judge says of a model in dB, see ``drawing.judging.Loss``."""

    @property
    def measured(self) -> float:
        """Against the truth, if it is known."""

    @property
    def expected(self) -> float:
        """0 or more, by the difference alone."""


@dataclass(frozen=True)
class Chosen:
    """Parts of a file.

    Attributes:
        parts: of it.
        loss: that was measured [dB].
    """

    parts: list[Part]
    loss: float


def choose(
    baked: Baked,
    bound: float,
    most: float,
    judge: Callable[[Baked], Lost],
    on_progress: OnProgress = lambda done, total: None,
) -> Chosen:
    """Return the parts of the smallest file that is found to lose, or gain, at most ``most`` dB.

    Args:
        baked: what is coded.
        bound: half edge of the cube that holds the scene [world units].
        most: that may be lost, above 0 [dB].
        judge: says what is lost by something in place of ``baked``.
        on_progress: called with how many tries are done, and are expected in all.

    Raises:
        DataError: the finest coding loses or gains more.
    """
    search = _Search(baked, bound, most, judge, on_progress)
    steps = steps_named(baked)
    start = search.coarsest(steps, 0, 1)
    steps = search.weighed({name: step * 2.0**start for name, step in steps.items()})
    power = search.coarsest(steps, 0, HALVINGS)
    found = search.chosen({name: step * 2.0**power for name, step in steps.items()})
    on_progress(search.tries, search.tries)
    return found


class _Search:
    """Tries of steps."""

    def __init__(
        self,
        baked: Baked,
        bound: float,
        most: float,
        judge: Callable[[Baked], Lost],
        on_progress: OnProgress,
    ) -> None:
        self.baked, self.bound, self.most, self.judge = baked, bound, most, judge
        self.on_progress, self.tries = on_progress, 0
        self.expected = 12 + len(steps_named(baked))

    def chosen(self, steps: Mapping[str, float]) -> Chosen:
        """Return the parts with these steps, and what is lost."""
        tables = self._coded(steps)
        return Chosen([packed(table) for table in tables], self._lost(tables).measured)

    def coarsest(self, steps: Mapping[str, float], start: int, finer: int) -> float:
        """Return the largest power of two whose multiple of the steps loses no more than allowed.

        Args:
            steps: to begin with.
            start: a power.
            finer: 1 for whole powers; each more halves the distance of those that are tried.

        Raises:
            DataError: the finest lose or gain more.
        """
        power: float = start
        if self._fits(steps, power):
            while power < COARSEST and self._fits(steps, power + 1):
                power += 1
        else:
            power -= 1
            while not self._fits(steps, power):
                if power <= FINEST:
                    raise DataError(
                        f"even the finest coding loses more than {self.most:g} dB; allow more"
                    )
                power -= 1
        for halving in range(1, finer):
            if self._fits(steps, power + 2.0**-halving):
                power += 2.0**-halving
        return power

    def weighed(self, steps: Mapping[str, float]) -> dict[str, float]:
        """Return steps that add up to the same loss with fewer bytes."""
        both = steps, _times(steps, 2.0)
        sizes, smaller = (_sizes([packed(t, QUICKLY) for t in self._coded(s)]) for s in both)
        fine = _times(steps, ALONE)
        losses, prices = {}, {}
        for name in steps:
            losses[name] = max(
                self._lost(self._coded(fine | {name: steps[name]})).expected, LEAST_LOSS
            )
            prices[name] = max(sizes.get(name, 0) - smaller.get(name, 0), 1)
        whole = sum(prices.values())
        return {
            name: step * _within(math.sqrt(self.most * prices[name] / whole / losses[name]))
            for name, step in steps.items()
        }

    def _fits(self, steps: Mapping[str, float], power: float) -> bool:
        # What a coarse file gains by chance, a bad model's may, is not the model's either.
        return abs(self._lost(self._coded(_times(steps, 2.0**power))).measured) <= self.most

    def _coded(self, steps: Mapping[str, float]) -> list[Table]:
        """Return tables, not packed: most of the time of all tries would go into that."""
        return coded(self.baked, steps, self.bound)

    def _lost(self, tables: list[Table]) -> Lost:
        self.tries += 1
        self.on_progress(min(self.tries, self.expected - 1), self.expected)
        return self.judge(decoded(described(self.baked), {table.name: table for table in tables}))


def _times(steps: Mapping[str, float], factor: float) -> dict[str, float]:
    return {name: step * factor for name, step in steps.items()}


def _within(change: float) -> float:
    return min(max(change, 1 / MOST_CHANGE), MOST_CHANGE)


def _sizes(parts: list[Part]) -> dict[str, int]:
    """Return the bytes of what has steps of its own: of a track its curves and shares."""
    sizes: dict[str, int] = {}
    for part in parts:
        name = part.name.removeprefix(CURVES).removeprefix(SHARES)
        sizes[name] = sizes.get(name, 0) + len(part.stream)
    return sizes
