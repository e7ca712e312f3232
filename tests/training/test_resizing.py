"""Resizing the splats of a training: everything that has a row for each of them follows."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from motion_checks import splats_of
from training_checks import SETTLING, STEPS, copies, per_splat, preset_of, trainer_of

from gsdmsr_cli.ground.errors import GsdmsrError
from gsdmsr_cli.training.resizing import Population, Resize, kept
from gsdmsr_cli.training.trainer import Trainer

MARKS = torch.arange(120.0)
ROWS = torch.tensor([119, 3, 3, 0, 77])


@pytest.fixture
def trainer(tiny_scene: Path) -> Trainer:
    """A training that moves, of 120 splats; what is kept for each is marked by its row."""
    learning = "layers=[{name: lighting}, {name: shading, since: 0}]"
    options = "density.start=999", "splats.sh_degree=1", learning
    trainer = trainer_of(tiny_scene, preset_of(*options))
    for _ in range(8):
        trainer.step()
    population = trainer.population
    population.average.add(trainer.model.parameters())
    population.statistics.total = MARKS.clone()
    population.saliency.scores = MARKS.clone()
    for moments in (population.optimizer.first, population.optimizer.second):
        for name in per_splat(trainer.model):
            shape = moments[name].shape
            moments[name] = MARKS.view(-1, *[1] * (len(shape) - 1)).expand(shape).clone()
    return trainer


def test_everything_follows_a_resize_without_new_splats(trainer: Trainer) -> None:
    population, model = trainer.population, trainer.model
    before, average = copies(model.tensors()), copies(population.average.tensors)
    population.resize(kept(ROWS))
    assert torch.equal(population.statistics.total, MARKS[ROWS])
    assert torch.equal(population.saliency.scores, MARKS[ROWS])
    assert population.average.count == 1
    assert {"splats.sh", "motion.embeddings"} <= set(per_splat(model))
    for name, tensor in model.tensors().items():
        rows = ROWS if name in per_splat(model) else slice(None)
        assert torch.equal(tensor, before[name][rows]), name
        assert torch.equal(population.average.tensors[name], average[name][rows]), name
        if name in per_splat(model):
            first = population.optimizer.first[name]
            assert torch.equal(first.view(len(first), -1)[:, 0], MARKS[ROWS]), name
            assert torch.equal(population.optimizer.second[name], first), name


def test_new_splats_have_their_own_values_no_momentum_and_end_the_average(
    trainer: Trainer,
) -> None:
    population, model = trainer.population, trainer.model
    fresh, values = torch.tensor([False, False, True, False, True]), splats_of(5)
    values = values.map(torch.clone)
    population.resize(Resize(ROWS, fresh, values))
    for name, tensor in values.tensors().items():
        assert torch.equal(getattr(model.splats, name), tensor), name
    for name in per_splat(model):
        first = population.optimizer.first[name].view(5, -1)[:, 0]
        assert first.tolist() == [119.0, 3.0, 0.0, 0.0, 0.0], name
    assert population.average.count == 0 and not population.average.tensors
    options = population.saliency.options
    again = options.threshold
    assert population.saliency.scores.tolist() == pytest.approx([119, 3, again, 0, again])
    assert population.saliency.grace[fresh].tolist() == [options.grace] * 2


def test_splats_that_move_come_first_and_statistics_with_them(tiny_scene: Path) -> None:
    trainer = trainer_of(tiny_scene, preset_of(*SETTLING))
    for _ in range(STEPS):
        trainer.step()
    population, model = trainer.population, trainer.model
    moving, count = model.moving, len(model.splats)
    assert 1 < moving < count - 1
    means = model.splats.means.detach().clone()
    population.statistics.total = torch.arange(float(count))
    rows = torch.tensor([count - 1, 0, moving, moving - 1])
    population.resize(kept(rows))
    order = torch.tensor([0, moving - 1, count - 1, moving])
    assert model.moving == 2 and torch.equal(model.splats.means, means[order])
    assert torch.equal(population.statistics.total, order.float())
    assert len(model.tensors()["motion.embeddings"]) == 2
    assert len(population.optimizer.first["motion.embeddings"]) == 2
    population.resize(Resize(torch.arange(4), torch.zeros(4).bool(), still=torch.arange(4) == 0))
    assert model.moving == 1
    assert torch.equal(population.statistics.total, order[[1, 0, 2, 3]].float())


def resized_to(population: Population, count: int) -> None:
    rows = torch.arange(count) % len(population.model.splats)
    population.resize(Resize(rows, torch.arange(count) >= len(population.model.splats)))


def test_the_cap_holds_whoever_resizes(trainer: Trainer) -> None:
    population = trainer.population
    resized_to(population, 200)
    before = copies(population.model.tensors())
    with pytest.raises(GsdmsrError, match=r"^201 splats are more than density\.cap, 200; "):
        resized_to(population, 201)
    assert all(torch.equal(t, before[name]) for name, t in population.model.tensors().items())
    population.cap = 100  # a training may begin with more: these may be kept
    resized_to(population, 200)
    with pytest.raises(GsdmsrError, match="201 splats"):
        resized_to(population, 201)
