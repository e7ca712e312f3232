"""A layer that only recolours, in one file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from seam_checks import assert_trains_the_same_in_all_ways
from training_checks import SETTLING, STEPS, preset_of, trainer_of

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.training.trainer import check_plugins


@dataclass(frozen=True)
class Options:
    """Settings: how many values the colour has over time, 2 or more."""

    keys: int = 4


class Recolour(Layer):
    """All splats take on a colour that is linear between keys in time."""

    concerns_still = True

    def __init__(self, options: Options) -> None:
        self.colours = torch.zeros(options.keys, 3)
        super().__init__([Parameter("colours", self.colours, rate="network")])

    def at(self, moment: Moment, instant: Instant) -> Moment:
        along = instant.time * (len(self.colours) - 1)
        key = min(int(along), len(self.colours) - 2)
        colour = torch.lerp(self.colours[key], self.colours[key + 1], along - key)
        sh = moment.splats.sh
        recoloured = torch.cat([sh[:, :1] + colour, sh[:, 1:]], dim=1)
        return replace(moment, splats=replace(moment.splats, sh=recoloured))


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> Recolour:
    return Recolour(options)


OPTIONS = ("layers=[{name: test_recolour, keys: 3}]", "optimizer.network=[0.02,0.002]")


def test_it_trains_with_workers_without_and_resumed(tiny_scene: Path, tmp_path: Path) -> None:
    trainer = assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, *OPTIONS)
    assert trainer.model.tensors()["layers.test_recolour.colours"].any()


def test_splats_that_stand_still_change_their_colour_and_nothing_else(tiny_scene: Path) -> None:
    trainer = trainer_of(tiny_scene, preset_of(*SETTLING, *OPTIONS))
    for _ in range(STEPS):
        trainer.step()
    model = trainer.model
    assert 0 < model.moving < len(model.splats)
    with torch.no_grad():
        model.tensors()["layers.test_recolour.colours"][0] += 1
    one, two = (model.at(model.instant(time)).splats for time in (0.0, 1.0))
    still = slice(model.moving, None)
    for name, tensor in one.tensors().items():
        assert torch.equal(tensor[still], getattr(two, name)[still]) == (name != "sh"), name


def test_a_layer_that_is_named_twice_is_told(tiny_scene: Path) -> None:
    preset = preset_of("layers=[{name: test_recolour}, {name: test_recolour, keys: 3}]")
    for refuse in (lambda: check_plugins(preset), lambda: trainer_of(tiny_scene, preset)):
        with pytest.raises(UsageError, match=r"^layers names 'test_recolour' twice; drop one$"):
            refuse()


def test_an_unknown_option_of_a_layer_is_told() -> None:
    with pytest.raises(UsageError, match=r"unknown key 'kyes'; did you mean 'keys'\?"):
        check_plugins(preset_of("layers=[{name: test_recolour, kyes: 3}]"))
