"""Values that are not finite: a training goes on without them, or ends with a good checkpoint."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from torch import Tensor
from training_checks import STEPS, assert_same_tensors, copies, preset_of, run_of, trainer_of

from gsdmsr_cli.commands._training_display import describe
from gsdmsr_cli.ground.errors import GsdmsrError
from gsdmsr_cli.model.model import STORED, Model
from gsdmsr_cli.training.gradients.phase import Order, Phase, ViewGradients
from gsdmsr_cli.training.loop import train
from gsdmsr_cli.training.resizing import kept
from gsdmsr_cli.training.trainer import PATIENCE, Trainer

VALUES = pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])


def after(trainer: Trainer, steps: int) -> list[float]:
    return [trainer.step().loss.item() for _ in range(steps)]


def moving_trainer(data: Path, *options: str) -> Trainer:
    trainer = trainer_of(data, preset_of("density.start=999", *options))
    after(trainer, 8)
    return trainer


@VALUES
@pytest.mark.parametrize("name", [*STORED, "motion.embeddings"])
def test_a_splat_that_is_not_finite_is_dropped_and_told(
    tiny_scene: Path, tmp_path: Path, name: str, value: float
) -> None:
    trainer = moving_trainer(tiny_scene)
    trainer.model.tensors()[name].data[5].view(-1)[-1] = value
    moments = trainer.optimizer.second["splats.sh"].clone()
    assert math.isfinite(trainer.step().loss)
    assert len(trainer.model.splats) == 119 == len(trainer.population.statistics.total)
    assert trainer.population.dropped == 1
    assert trainer.clock.step == trainer.optimizer.steps[name] == 9 or name not in STORED
    assert len(trainer.optimizer.second["splats.sh"]) == len(moments) - 1
    checkpoint = trainer.checkpoint()
    assert all(t.isfinite().all() for t in checkpoint.tensors.values())
    run = run_of(trainer, tmp_path / "run")
    run.save(checkpoint)
    resumed = trainer_of(tiny_scene, trainer.preset)
    resumed.restore(run.load())
    assert resumed.population.dropped == 1 and len(resumed.model.splats) == 119


def test_a_training_goes_on_as_if_the_splat_had_never_been(tiny_scene: Path) -> None:
    """To the last bit, while splats grow, opacities are reset and the motion enters its phases."""
    poisoned, without = (trainer_of(tiny_scene, preset_of()) for _ in range(2))
    for trainer in (poisoned, without):
        after(trainer, 9)
    poisoned.model.splats.means.data[7, 1] = math.nan
    rows = torch.arange(len(without.model.splats))
    without.population.resize(kept(rows[rows != 7]))
    assert after(poisoned, STEPS - 9) == after(without, STEPS - 9)
    assert poisoned.population.dropped == 1 and without.population.dropped == 0
    tensors = poisoned.checkpoint().tensors
    assert_same_tensors(copies(tensors), copies(without.checkpoint().tensors))
    assert all(t.isfinite().all() for t in poisoned.model.tensors().values())


def poison_at(trainer: Trainer, step: int, count: int) -> None:
    """Let the gradients of so many splats not be finite in one step of a training."""
    true = trainer.renderer.gradients

    def gradients(model: Model, orders: Sequence[Order], phase: Phase) -> list[ViewGradients]:
        found = true(model, orders, phase)
        means = found[0].gradients[list(model.trained()).index("splats.means")]
        assert means is not None
        if trainer.clock.step == step:
            means[:count] = math.nan
        return found

    trainer.renderer.gradients = gradients  # type: ignore[method-assign]


def test_what_is_dropped_is_logged_and_told(tiny_scene: Path, tmp_path: Path) -> None:
    trainer, lines = trainer_of(tiny_scene, preset_of("density.start=999")), []
    run = run_of(trainer, tmp_path / "run")
    poison_at(trainer, 10, 2)
    assert train(trainer, run, lambda report: lines.append(describe(report)))
    log = [json.loads(line) for line in run.log_path.read_text().splitlines()]
    found = {entry["step"]: (entry["splats"], entry["dropped"]) for entry in log}
    assert found == {step: (120, 0) if step <= 11 else (118, 2) for step in range(1, STEPS + 1)}
    assert [" (2 dropped) " in line for line in lines] == [step > 11 for step in found]
    assert run.load().state["dropped"] == 2


@pytest.mark.parametrize("interval", [1e-9, 1000])
def test_the_last_checkpoint_of_a_training_that_has_diverged_is_whole(
    tiny_scene: Path, tmp_path: Path, interval: float
) -> None:
    """Also where the next one was to be saved right after the step that broke the splats."""
    option = f"training.checkpoint_minutes={interval}"
    trainer = trainer_of(tiny_scene, preset_of(option, "density.start=999"))
    run = run_of(trainer, tmp_path / "run")
    run.save(trainer.checkpoint())
    poison_at(trainer, 10, 61)
    with pytest.raises(GsdmsrError, match=r"61 of 120 splats .* the last checkpoint is kept"):
        train(trainer, run, lambda report: None)
    checkpoint = run.load()
    assert checkpoint.step == (10 if interval < 1 else 0)
    assert all(t.isfinite().all() for t in checkpoint.tensors.values() if t.is_floating_point())
    resumed = trainer_of(tiny_scene, trainer.preset)
    resumed.restore(checkpoint)
    assert all(map(math.isfinite, after(resumed, 3)))


def test_a_checkpoint_holds_no_values_that_are_not_finite(tiny_scene: Path, tmp_path: Path) -> None:
    """Nor does the one of a training whose last step has broken a splat."""
    trainer = trainer_of(tiny_scene, preset_of("density.start=999"))
    run = run_of(trainer, tmp_path / "run")
    poison_at(trainer, STEPS - 1, 1)
    assert train(trainer, run, lambda report: None)
    checkpoint = run.load()
    assert checkpoint.step == STEPS and len(checkpoint.tensors["splats.means"]) == 119
    assert all(t.isfinite().all() for t in checkpoint.tensors.values() if t.is_floating_point())


def test_a_training_that_loses_most_splats_ends(tiny_scene: Path) -> None:
    trainer = moving_trainer(tiny_scene)
    trainer.model.splats.means.data[:60] = math.nan
    trainer.step()  # half of them may go
    assert len(trainer.model.splats) == 60
    trainer.model.splats.quats.data[:31] = math.inf
    with pytest.raises(GsdmsrError, match="31 of 60 splats have values that are not finite"):
        trainer.step()


class Poisoned:
    """Renders as a trainer does, but a gradient of what all splats share is not finite."""

    def __init__(self, trainer: Trainer, value: float) -> None:
        self.true, self.value = trainer.renderer.gradients, value
        trainer.renderer.gradients = self  # type: ignore[method-assign, assignment]

    def __call__(self, model: Model, orders: Sequence[Order], phase: Phase) -> list[ViewGradients]:
        found = self.true(model, orders, phase)
        gradient = found[0].gradients[list(model.trained()).index("motion.decoder.1.weight")]
        assert gradient is not None
        gradient[3, 4] = self.value
        return found


def state_of(trainer: Trainer) -> dict[str, Tensor]:
    tensors = copies(trainer.checkpoint().tensors)
    del tensors["generator"]
    return tensors


@VALUES
def test_a_step_with_a_shared_gradient_that_is_not_finite_changes_nothing(
    tiny_scene: Path, value: float
) -> None:
    """Neither the model nor moments, statistics of density, tiles and saliency."""
    tiles = "losses.ssim=0", "training.tiles_per_view=2"
    gate = "saliency.gate=scale", "saliency.gate_from=0.1"
    trainer = moving_trainer(tiny_scene, *tiles, *gate)
    true, before = trainer.renderer.gradients, state_of(trainer)
    assert {"density.total", "saliency.scores"} <= before.keys()
    assert any(name.startswith("tiles.") for name in before)
    Poisoned(trainer, value)
    assert math.isnan(trainer.step().loss)
    assert trainer.clock.step == 9
    found = state_of(trainer)
    assert found.keys() == before.keys()
    for name, tensor in before.items():
        torch.testing.assert_close(found[name], tensor, atol=0, rtol=0, equal_nan=True)
    trainer.renderer.gradients = true  # type: ignore[method-assign]
    assert all(map(math.isfinite, after(trainer, 3)))


def test_training_gives_up_after_many_such_steps(tiny_scene: Path) -> None:
    at_once = "training.static_until=0", "motion.coarse_until=0"
    trainer = moving_trainer(tiny_scene, "training.steps=1000", *at_once)
    Poisoned(trainer, math.nan)
    after(trainer, PATIENCE - 1)
    with pytest.raises(GsdmsrError, match=r"a gradient of what all splats share, is not finite"):
        trainer.step()


def test_a_training_without_such_values_drops_nothing(tiny_scene: Path) -> None:
    trainer = moving_trainer(tiny_scene)
    before = copies(trainer.model.tensors())
    trainer.population.drop_not_finite()
    assert_same_tensors(copies(trainer.model.tensors()), before)
    assert trainer.population.dropped == 0
