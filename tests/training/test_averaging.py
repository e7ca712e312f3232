"""The average of a model's tensors, by itself and in a training."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_checks import generator
from training_checks import preset_of, trainer_of

from gsdmsr_cli.training.averaging import EVERY, Average
from gsdmsr_cli.training.trainer import Trainer


def after(trainer: Trainer, steps: int) -> None:
    for _ in range(steps):
        trainer.step()


@given(st.integers(1, 9))
@settings(deadline=None)
def test_it_is_the_mean_of_what_was_added(count: int) -> None:
    values = torch.randn(count, 5, 3, generator=generator(count))
    average = Average()
    for value in values:
        average.add({"x": value.requires_grad_()})
    assert average.count == count
    torch.testing.assert_close(average.tensors["x"], values.mean(0).detach())
    assert not average.tensors["x"].requires_grad


def test_it_keeps_no_hold_of_what_was_added() -> None:
    value, average = torch.ones(3), Average()
    average.add({"x": value})
    value += 1
    assert torch.equal(average.tensors["x"], torch.ones(3))


def test_take_follows_a_resize_and_forget_begins_anew() -> None:
    average = Average()
    average.add({"splats": torch.arange(4.0), "field": torch.ones(2)})
    average.take(["splats", "not there"], torch.tensor([3, 1]))
    assert average.tensors["splats"].tolist() == [3.0, 1.0]
    assert average.tensors["field"].tolist() == [1.0, 1.0]
    average.forget()
    average.add({"splats": torch.zeros(5)})
    assert average.count == 1 and len(average.tensors["splats"]) == 5


def test_a_trainings_result_is_the_mean_over_its_end(tiny_scene: Path) -> None:
    steps = 4 * EVERY
    preset = preset_of(f"training.steps={steps}", "training.average_from=0.5", "density.until=0")
    trainer = trainer_of(tiny_scene, preset)
    seen = []
    for step in range(1, steps + 1):
        trainer.step()
        if step <= steps / 2:
            assert trainer.result() is trainer.model
        elif step % EVERY == 0:
            seen.append({n: t.detach().clone() for n, t in trainer.model.tensors().items()})
    assert len(seen) == 2
    result = trainer.result().tensors()
    for name, tensor in trainer.model.tensors().items():
        expected = torch.stack([values[name] for values in seen]).mean(0)
        torch.testing.assert_close(result[name].detach(), expected, msg=name)
        assert torch.equal(tensor.detach(), seen[-1][name]), name


def test_without_an_end_to_average_the_result_is_the_model(tiny_scene: Path) -> None:
    preset = preset_of(f"training.steps={2 * EVERY}", "training.average_from=1")
    trainer = trainer_of(tiny_scene, preset)
    after(trainer, 2 * EVERY)
    assert trainer.result() is trainer.model


def test_going_back_in_progress_drops_the_average(tiny_scene: Path) -> None:
    preset = preset_of(f"training.steps={2 * EVERY}", "training.average_from=0.5")
    trainer = trainer_of(tiny_scene, preset)
    after(trainer, 2 * EVERY)
    assert trainer.result() is not trainer.model
    trainer.clock.steps = 10 * EVERY
    after(trainer, EVERY)
    assert trainer.result() is trainer.model


@pytest.mark.parametrize("done", [EVERY, 3 * EVERY + 3])
def test_a_checkpoint_holds_the_result_and_what_to_go_on_from(tiny_scene: Path, done: int) -> None:
    preset = preset_of(f"training.steps={4 * EVERY}", "training.average_from=0.5")
    trainer, other = trainer_of(tiny_scene, preset), trainer_of(tiny_scene, preset)
    after(trainer, done)
    checkpoint = trainer.checkpoint()
    for name, tensor in trainer.result().tensors().items():
        assert torch.equal(checkpoint.tensors[name], tensor), name
    other.restore(checkpoint)
    assert other.average.count == trainer.average.count
    for model, copied in ((trainer.model, other.model), (trainer.result(), other.result())):
        for name, tensor in model.tensors().items():
            assert torch.equal(copied.tensors()[name], tensor), name
