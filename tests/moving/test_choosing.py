"""The search for coarse steps keeps to what may be lost, and spends bytes where they buy most."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest
import torch
from motion_checks import FACTS, disturbed, splats_of, started
from torch import Tensor

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.model.model import MOTION, Model
from gsdmsr_cli.moving.baked import Baked
from gsdmsr_cli.moving.baking import bake
from gsdmsr_cli.moving.choosing import choose
from gsdmsr_cli.moving.playing import model_of

START = {"means": 2.0**-13, "log_scales": 2.0**-5, "sh_0": 2.0**-6}
"""Steps that the search begins with."""


@dataclass(frozen=True)
class Said:
    measured: float
    expected: float


class Distance:
    """A judge to whom nothing matters but colours and places."""

    def __init__(self, baked: Baked) -> None:
        self.places, self.colours = self._seen(baked)

    def _seen(self, baked: Baked) -> tuple[Tensor, Tensor]:
        model = model_of(baked)
        splats = model.at(model.instant(0.3)).splats
        order = splats.sh[:, 0, 0].argsort()  # whatever the order of the rows
        return splats.means[order], splats.sh[order, 0]

    def __call__(self, baked: Baked) -> Said:
        places, colours = self._seen(baked)
        apart = 1e4 * (places - self.places).square().mean()
        loss = float((apart + (colours - self.colours).square().mean()).detach())
        return Said(loss, loss)


@pytest.fixture(scope="module")
def baked() -> Baked:
    splats = splats_of(200)
    splats = replace(splats, logit_opacities=splats.logit_opacities.abs())
    splats.sh[:, 0] = torch.linspace(-1, 1, 200)[:, None]  # so that rounding keeps their order
    return bake(Model(splats, {MOTION: disturbed(started("control_points", 200))}), FACTS.frames)


@pytest.mark.parametrize("most", [1e-2, 1e-3])
def test_as_much_is_lost_as_may_be(baked: Baked, most: float) -> None:
    calls = []
    judge = Distance(baked)
    chosen = choose(
        baked, FACTS.bound, most, judge, lambda done, total: calls.append((done, total))
    )
    assert 0.5 * most < chosen.loss <= most
    assert calls[-1][0] == calls[-1][1] and all(done <= total for done, total in calls)


def test_less_loss_takes_more_bytes(baked: Baked) -> None:
    sizes = [
        sum(len(part.stream) for part in choose(baked, FACTS.bound, most, Distance(baked)).parts)
        for most in (1e-4, 1e-2)
    ]
    assert sizes[0] > 1.2 * sizes[1]


def test_what_does_not_matter_is_coarser_than_what_does(baked: Baked) -> None:
    chosen = choose(baked, FACTS.bound, 1e-3, Distance(baked))
    steps = {part.name: part.step[0] for part in chosen.parts}
    change = {name: steps[name] / step for name, step in START.items()}
    assert change["log_scales"] > max(2 * change["sh_0"], 1.1 * change["means"])


def test_what_coding_gains_by_chance_counts_as_what_it_loses(baked: Baked) -> None:
    """A file of a model that is bad as yet is to show that model."""
    lost = Distance(baked)

    def judge(other: Baked) -> Said:
        loss = lost(other)
        return Said(-loss.measured, loss.expected)

    chosen = choose(baked, FACTS.bound, 1e-3, judge)
    assert -1e-3 <= chosen.loss < -0.5e-3


def test_a_loss_that_no_coding_keeps_to_is_an_error(baked: Baked) -> None:
    with pytest.raises(DataError, match=r"even the finest coding loses more than 0\.1 dB"):
        choose(baked, FACTS.bound, 0.1, lambda other: Said(0.2, 0.2))
