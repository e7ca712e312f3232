"""An event that adds splats, in one file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from seam_checks import assert_trains_the_same_in_all_ways
from training_checks import SETTLING, STEPS, preset_of, trainer_of

from gsdmsr_cli.ground.errors import GsdmsrError
from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.training.population import Event, Tick
from gsdmsr_cli.training.resizing import Population, Resize


@dataclass(frozen=True)
class Options:
    """Settings: how many splats are added at a time, and after how many steps each."""

    count: int = 5
    every: int = 10


class Spawning(Event):
    """Adds copies of splats at random, beside where these are."""

    def __init__(self, options: Options) -> None:
        self.options, self.times = options, 0

    def due(self, tick: Tick) -> bool:
        return tick.step % self.options.every == 0

    def apply(self, population: Population, tick: Tick) -> Resize:
        self.times += 1
        own, count = population.model.splats.detach(), len(population.model.splats)
        chosen = torch.randint(count, (self.options.count,), generator=population.generator)
        rows = torch.cat([torch.arange(count), chosen])
        fresh = torch.arange(len(rows)) >= count
        splats = own.take(rows)
        noise = torch.randn(len(rows), 3, generator=population.generator)
        splats.means[fresh] += 0.01 * population.radius * noise[fresh]
        return Resize(rows, fresh, splats)

    def state(self) -> dict[str, Any]:
        return {"times": self.times}

    def restore(self, state: Mapping[str, Any]) -> None:
        self.times = int(state["times"])


def start(options: Options, preset: Preset) -> Spawning:
    return Spawning(options)


UNPRUNED = "density.gradient=1.0", "density.prune_opacity=0.0", "density.prune_scale=1000000.0"
EVENTS = "events=[density, opacity_reset, thinning, stillness, {name: test_spawning, count: 7}]"


def test_it_trains_with_workers_without_and_resumed(tiny_scene: Path, tmp_path: Path) -> None:
    options = EVENTS, *UNPRUNED
    trainer = assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, *options)
    assert len(trainer.model.splats) == 120 + 7 * (STEPS // 10)
    assert trainer.checkpoint().state["events"]["test_spawning"] == {"times": STEPS // 10}


def test_new_splats_have_no_momentum_and_stand_before_those_that_do_not_move(
    tiny_scene: Path,
) -> None:
    trainer = trainer_of(tiny_scene, preset_of(*SETTLING, EVENTS, *UNPRUNED))
    for _ in range(STEPS):
        trainer.step()
    model = trainer.model
    assert 0 < model.moving < len(model.splats) == 120 + 7 * (STEPS // 10)
    first = trainer.optimizer.first["splats.means"]
    assert int((first == 0).all(dim=1).sum()) >= 7
    one, two = (model.at(model.instant(time)).splats.means for time in (0.0, 1.0))
    still = torch.arange(len(one)) >= model.moving
    assert torch.equal((one == two).all(dim=1), still)


def test_more_than_the_cap_is_refused(tiny_scene: Path) -> None:
    trainer = trainer_of(tiny_scene, preset_of(EVENTS, "density.cap=125", *UNPRUNED))
    with pytest.raises(GsdmsrError, match=r"127 splats are more than density\.cap, 125"):
        for _ in range(STEPS):
            trainer.step()
