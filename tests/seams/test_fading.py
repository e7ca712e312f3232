"""A motion with a temporal opacity and a learning rate of its own, in one file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from seam_checks import assert_trains_the_same_in_all_ways
from training_checks import STEPS, preset_of, trainer_of

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.training.rates import learning_rates

RATE = (0.02, 0.002)


@dataclass(frozen=True)
class Options:
    """Settings: the time for which splats begin to be seen."""

    duration: float = 2.0


class Fading(Layer):
    """Every splat has a velocity, and is opaque around a moment of its own."""

    identity_at_start = False

    def __init__(self, options: Options, splats: Splats, generator: torch.Generator) -> None:
        self.duration = options.duration
        self.velocities = torch.zeros(len(splats), 3)
        self.centres = torch.rand(len(splats), generator=generator)
        self.born = torch.arange(len(splats), dtype=torch.int16)
        super().__init__(
            [
                Parameter("velocities", self.velocities, per_splat=True, rate="means"),
                Parameter("centres", self.centres, per_splat=True, rate=RATE),
                Parameter("born", self.born, per_splat=True),
            ]
        )

    def at(self, moment: Moment, instant: Instant) -> Moment:
        apart = instant.time - self.centres
        splats = replace(
            moment.splats,
            means=moment.splats.means + apart[:, None] * self.velocities,
            logit_opacities=moment.splats.logit_opacities - (apart / self.duration) ** 2,
        )
        return replace(moment, splats=splats)


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> Fading:
    return Fading(options, splats, generator)


OPTIONS = ("motion={name: test_fading, duration: 0.5}",)


def test_it_trains_with_workers_without_and_resumed(tiny_scene: Path, tmp_path: Path) -> None:
    trainer = assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, *OPTIONS)
    layer = trainer.model.layers["motion"]
    assert {len(tensor) for tensor in layer.tensors().values()} == {200}  # it has grown
    assert layer.tensors()["velocities"].any()
    times = [trainer.model.at(trainer.model.instant(t)).splats for t in (0.0, 1.0)]
    assert not torch.equal(times[0].logit_opacities, times[1].logit_opacities)


def test_a_buffer_of_another_type_is_saved_and_follows_its_splats(tiny_scene: Path) -> None:
    trainer = trainer_of(tiny_scene, preset_of(*OPTIONS))
    for _ in range(STEPS):
        trainer.step()
    born = trainer.checkpoint().tensors["motion.born"]
    assert born.dtype == torch.int16 and len(born) == 200 and int(born.max()) < 120
    assert "adam.first.motion.born" not in trainer.checkpoint().tensors


def test_its_own_learning_rate_is_log_linear_in_progress(tiny_scene: Path) -> None:
    trainer = trainer_of(tiny_scene, preset_of(*OPTIONS))
    given = trainer.model.parameters(), trainer.preset.optimizer
    rates = [learning_rates(*given, p, 0.2, 3.0) for p in (0.2, 0.6, 1.0)]
    found = [rate["motion.centres"] for rate in rates]
    assert found == pytest.approx([0.02, (0.02 * 0.002) ** 0.5, 0.002])
    assert rates[0]["motion.velocities"] == rates[0]["splats.means"]
