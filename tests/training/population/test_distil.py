"""The event that lets groups of splats take over from a trained motion."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from seam_checks import assert_trains_the_same_in_all_ways
from training_checks import STEPS, preset_of, trainer_of

from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.training.population import Tick
from gsdmsr_cli.training.population.distil import Distil, Options
from gsdmsr_cli.training.trainer import check_plugins

MOTION = "motion={name: rigid_groups, count: 12, series: 3, base: {name: multiscale}}"
EVENTS = "events=[density, opacity_reset, {name: distil, at: 0.4}]"


def test_it_trains_with_workers_without_and_resumed(tiny_scene: Path, tmp_path: Path) -> None:
    """Splats go on growing after groups have taken over, and the training is resumed then."""
    trainer = assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, MOTION, EVENTS)
    tensors = trainer.checkpoint().tensors
    assert tensors["motion.taken_over"] == 1 and tensors["motion.keys"].any()
    assert not any(t.numel() for n, t in tensors.items() if n.startswith("motion.base."))
    assert not any(n.startswith("adam.first.motion.base.") for n in tensors)
    assert len(tensors["motion.group"]) == len(tensors["motion.shares"]) == 200  # it has grown
    assert trainer.checkpoint().state["events"]["distil"] == {"done": True}


def test_it_happens_once_from_its_progress_on_when_splats_move(tiny_scene: Path) -> None:
    trainer = trainer_of(tiny_scene, preset_of(MOTION, EVENTS))
    event = trainer.events["distil"]
    assert isinstance(event, Distil)
    assert [event.due(Tick(9, progress)) for progress in (0.39, 0.4, 0.9)] == [False, True, True]
    event.apply(trainer.population, Tick(9, 0.5))
    assert event.due(Tick(10, 0.5))  # nothing moves yet
    for _ in range(STEPS // 2):
        trainer.step()
    assert not event.due(Tick(21, 0.5))


def test_what_is_drawn_then_is_near_what_was_drawn_before(tiny_scene: Path) -> None:
    fast = "optimizer.planes=[0.05,0.01]", "optimizer.network=[0.02,0.002]"
    many = MOTION.replace("12", "64")
    trainer = trainer_of(tiny_scene, preset_of(many, "events=[{name: distil, at: 1.0}]", *fast))
    for _ in range(STEPS):
        trainer.step()
    model = trainer.model
    still = model.splats.means.detach().clone()
    with torch.no_grad():
        before = [model.at(model.instant(time)).splats.means for time in (0.0, 0.4, 1.0)]
        Distil(Options().at).apply(trainer.population, Tick(STEPS, 1.0))
        after = [model.at(model.instant(time)).splats.means for time in (0.0, 0.4, 1.0)]
    for one, two in zip(before, after, strict=True):
        assert (one - two).norm(dim=1).mean() < 0.2 * (one - still).norm(dim=1).mean()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            (EVENTS,),
            r"^events names 'distil', but the motion 'multiscale' has no base to take over from; "
            r"write motion: \{name: rigid_groups, base: \{name: multiscale\}\}$",
        ),
        ((MOTION, EVENTS.replace("0.4", "2")), "at is 2.0; allowed: a progress from 0 to 1"),
    ],
)
def test_what_cannot_be_is_refused_before_a_training(options: tuple[str], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        check_plugins(preset_of(*options))


def test_of_more_groups_than_splats_as_many_are_left(tiny_scene: Path, tmp_path: Path) -> None:
    """As in the warm-up before a training, which has a handful of splats."""
    many = MOTION.replace("12", "3000")
    trainer = assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, many, EVENTS)
    tensors = trainer.checkpoint().tensors
    groups = len(tensors["motion.anchors"])
    assert 64 < groups <= len(tensors["splats.means"])
    assert tensors["motion.keys"].shape[1] == tensors["adam.first.motion.keys"].shape[1] == groups
