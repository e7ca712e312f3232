"""Conversion: who is made dynamic and when, and that everything kept for each splat follows."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from seam_checks import assert_trains_the_same_in_all_ways
from training_checks import STEPS, copies, preset_of, trainer_of

from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.training.population import Tick
from gsdmsr_cli.training.population.convert import (
    Convert,
    Options,
    apparent_ways,
    farthest,
)
from gsdmsr_cli.training.resizing import Resize
from gsdmsr_cli.training.trainer import Trainer, check_plugins

PARTS = (
    "motion={name: keyframes, keyframes: 3}",
    "layers=[{name: life_span}, {name: drift, rate: [0.01, 0.001]}]",
    "training.static_until=0", "saliency.still_from=1.0",
)  # fmt: skip
EVENTS = "events=[{name: convert, share: 0.1, rounds: 8, start: 0.2}, density, opacity_reset]"


def trained(data: Path, steps: int, *options: str) -> Trainer:
    trainer = trainer_of(data, preset_of(*PARTS, EVENTS, *options))
    for _ in range(steps):
        trainer.step()
    return trainer


def test_it_trains_with_workers_without_and_resumed(tiny_scene: Path, tmp_path: Path) -> None:
    trainer = assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, *PARTS, EVENTS)
    model, tensors = trainer.model, trainer.model.tensors()
    assert 0 < model.moving < len(model.splats)
    assert len(tensors["layers.drift.ways"]) == len(model.splats)
    for name in ("motion.offsets", "motion.turns", "layers.life_span.starts"):
        assert len(tensors[name]) == model.moving, name
        assert len(trainer.optimizer.first[name]) == model.moving, name
    assert tensors["motion.offsets"].any()
    assert trainer.checkpoint().state["events"]["convert"] == {"begun": True, "rounds": 8}


def test_all_splats_stand_still_at_first(tiny_scene: Path) -> None:
    trainer = trained(tiny_scene, 2)
    assert trainer.model.moving == 0 and len(trainer.model.tensors()["motion.offsets"]) == 0
    assert trainer.model.tensors()["layers.drift.ways"].any()


def test_what_is_made_dynamic_is_drawn_as_before_but_for_its_life_span(tiny_scene: Path) -> None:
    trainer = trained(tiny_scene, 8, "density.start=999")
    population, model = trainer.population, trainer.model
    assert model.moving == 0
    time = model.instant(0.3)
    before = model.at(time).detach().splats
    change = Convert(Options(share=0.2))
    change.begun = True
    resize = change.apply(population, Tick(9, 0.5))
    assert resize is not None and resize.moving is not None
    population.resize(resize)
    order = resize.moving.to(torch.uint8).argsort(descending=True, stable=True)
    assert model.moving == int(resize.moving.sum()) > 0
    after = model.at(time).detach().splats
    for name in ("means", "quats", "log_scales", "sh"):
        assert torch.equal(getattr(after, name), getattr(before, name)[order]), name
    apart = after.logit_opacities - before.logit_opacities[order]
    assert apart.abs().max() < 0.05


def test_moments_and_averages_follow_both_ways(tiny_scene: Path) -> None:
    """From standing still to moving and back."""
    trainer = trained(tiny_scene, STEPS // 2, "density.start=999")
    population, model, adam = trainer.population, trainer.model, trainer.optimizer
    held, count = model.moving, len(model.splats)
    assert 2 < held < count - 2
    first, means = copies(adam.first), model.splats.means.detach().clone()
    offsets = model.tensors()["motion.offsets"].detach().clone()
    population.average.add(model.parameters())
    rows = torch.arange(count)
    population.resize(Resize(rows, rows < 0, moving=rows == count - 2, still=rows == 1))
    order = torch.cat([rows[:1], rows[2:held], rows[-2:-1], rows[1:2], rows[held:-2], rows[-1:]])
    assert model.moving == held and torch.equal(model.splats.means, means[order])
    assert torch.equal(model.tensors()["motion.offsets"][:-1], offsets[order[: held - 1]])
    assert not model.tensors()["motion.offsets"][-1].any()
    assert float(model.tensors()["layers.life_span.starts"][-1].detach()) == pytest.approx(0.1)
    assert torch.equal(
        adam.first["motion.offsets"][:-1], first["motion.offsets"][order[: held - 1]]
    )
    assert not adam.first["motion.offsets"][-1].any()
    for name in ("splats.means", "layers.drift.ways"):
        assert torch.equal(adam.first[name], first[name][order]), name
    assert population.average.count == 0
    population.average.add(model.parameters())
    population.resize(Resize(rows, rows < 0, still=rows == held - 1))
    assert model.moving == held - 1 and len(adam.second["motion.turns"]) == held - 1
    assert population.average.count == 1
    assert len(population.average.tensors["motion.turns"]) == held - 1


def test_only_static_splats_that_drift_and_are_seen_count(tiny_scene: Path) -> None:
    """The farther they go and the nearer they are, the more."""
    trainer = trained(tiny_scene, STEPS // 2, "density.start=999")
    population, model = trainer.population, trainer.model
    ((camera, time),) = population.shots(1)
    ways = model.tensors()["layers.drift.ways"].data
    ways.zero_()
    ways[[0, -1, -2, -3]] = torch.tensor([0.5, 0.01, 0.04, 0.01])[:, None]
    eye = torch.from_numpy(camera.centre).float()
    ahead = torch.from_numpy(camera.rotation[2]).float()
    model.splats.means.data[[0, -1, -2]] = eye + 4 * ahead
    model.splats.means.data[-3] = eye - 4 * ahead
    model.splats.logit_opacities.data[[0, -1, -2, -3]] = 3.0
    found = apparent_ways(population, camera, time)
    assert found.nonzero().flatten().tolist() == [len(found) - 2, len(found) - 1]
    assert float(found[-2] / found[-1]) == pytest.approx(4.0, rel=0.05)
    far = 0.01 * 3**0.5 * model.layers["layers.drift"].bound / 16
    assert float(found[-1]) == pytest.approx(far, rel=0.05)


def test_the_farthest_are_a_share_of_those_that_go_anywhere() -> None:
    ways = torch.tensor([0.0, 3.0, 0.0, 1.0, 2.0, 0.5, 0.1])
    assert farthest(ways, 0.4).tolist() == [1, 4]
    assert farthest(ways, 0.41).tolist() == [1, 4, 3]
    assert farthest(ways, 1.0).tolist() == [1, 4, 3, 5, 6]
    assert farthest(torch.zeros(3), 0.5).tolist() == []


def test_rounds_are_spread_evenly_over_progress() -> None:
    event = Convert(Options(rounds=4, start=0.25, until=0.75))
    assert event.due(Tick(1, 0.0))
    event.begun, happened = True, []
    for step in range(64):
        if event.due(Tick(step, step / 64)):
            happened.append(step)
            event.rounds += 1
    assert happened == [16, 24, 32, 40]
    again = Convert(Options())
    again.restore(event.state())
    assert again.begun and again.rounds == 4


@pytest.mark.parametrize(
    ("options", "found"),
    [
        ("share: 0", "share is 0.0; allowed: above 0, at most 1"),
        ("rounds: 0", "rounds is 0; allowed: 1 or more"),
        ("start: 1", "start is 1.0; allowed: 0 or more, below 1"),
        ("until: 0.01", "until is 0.01; allowed: above start, at most 1"),
    ],
)
def test_options_out_of_range_are_refused(options: str, found: str) -> None:
    with pytest.raises(UsageError, match=f"{found}$"):
        check_plugins(preset_of(f"events=[{{name: convert, {options}}}]"))
