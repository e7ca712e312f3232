"""The average of a model's tensors, by itself and in a training."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_checks import generator
from torch import Tensor
from training_checks import preset_of, trainer_of

from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.training.averaging import EVERY, Average
from gsdmsr_cli.training.trainer import Trainer


def trained(**values: Tensor) -> list[Parameter]:
    return [Parameter(name, value.clone(), rate="means") for name, value in values.items()]


def after(trainer: Trainer, steps: int) -> None:
    for _ in range(steps):
        trainer.step()


@given(st.integers(1, 9))
@settings(deadline=None)
def test_it_is_the_mean_of_what_was_added(count: int) -> None:
    values = torch.randn(count, 5, 3, generator=generator(count))
    average = Average()
    for value in values:
        average.add(trained(x=value))
    assert average.count == count
    torch.testing.assert_close(average.tensors["x"], values.mean(0).detach())
    assert not average.tensors["x"].requires_grad


def test_it_keeps_no_hold_of_what_was_added() -> None:
    (parameter,), average = trained(x=torch.ones(3)), Average()
    average.add([parameter])
    with torch.no_grad():
        parameter.tensor.add_(1)
    assert torch.equal(average.tensors["x"], torch.ones(3))


def test_of_what_is_not_trained_the_last_values_count() -> None:
    """Such as indices, which have no mean."""
    buffer, average = Parameter("rows", torch.tensor([4, 2])), Average()
    average.add([buffer])
    average.add([Parameter("rows", torch.tensor([1, 3]))])
    assert average.tensors["rows"].tolist() == [1, 3]
    assert average.tensors["rows"].dtype == torch.int64 and average.count == 2


def test_take_follows_a_resize_and_clear_begins_anew() -> None:
    average = Average()
    average.add(trained(splats=torch.arange(4.0), field=torch.ones(2)))
    for name in ("splats", "not there"):
        average.take(name, torch.tensor([3, 1]))
    assert average.tensors["splats"].tolist() == [3.0, 1.0]
    assert average.tensors["field"].tolist() == [1.0, 1.0]
    average.clear()
    average.add(trained(splats=torch.zeros(5)))
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
    assert other.population.average.count == trainer.population.average.count
    for model, copied in ((trainer.model, other.model), (trainer.result(), other.result())):
        for name, tensor in model.tensors().items():
            assert torch.equal(copied.tensors()[name], tensor), name
