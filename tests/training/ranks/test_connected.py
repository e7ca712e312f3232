"""Ranks agree on the time and the end, and notice that they hold different models."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import pytest
import torch
from torch import Tensor
from training_checks import preset_of, trainer_of

from gsdmsr_cli.training.ranks.alone import ALONE, RanksDifferError, most_of
from gsdmsr_cli.training.ranks.connected import CHECK_EVERY, Connected, checksum_of
from gsdmsr_cli.training.ranks.link import Link
from gsdmsr_cli.training.trainer import Trainer


class Scripted:
    """A link that knows what the other rank says."""

    rank, size, seconds, received = 0, 2, 0.0, 0

    def __init__(self) -> None:
        self.sent: list[Tensor] = []
        self.change = lambda row: row

    def gather(self, own: Tensor) -> list[Tensor]:
        self.sent.append(own)
        return [own, self.change(own.clone())]


@pytest.fixture
def trainer(tiny_scene: Path) -> Trainer:
    return trainer_of(tiny_scene, preset_of())


def meet(trainer: Trainer, link: Scripted, end_wanted: bool = False) -> bool:
    trainer.ranks = Connected(cast(Link, cast(Any, link)))
    return trainer.meet(end_wanted)


def test_one_alone_does_what_it_wants(trainer: Trainer) -> None:
    given = trainer.clock, trainer.model, trainer.generator
    assert [ALONE.meet(*given, wanted) for wanted in (False, True)] == [False, True]
    assert trainer.clock.told is None and ALONE.account() == {}


def test_the_end_that_any_rank_wants_is_wanted(trainer: Trainer) -> None:
    link = Scripted()
    assert not meet(trainer, link)
    assert meet(trainer, link, end_wanted=True)
    link.change = lambda row: row + torch.tensor([0.0, 1, 0, 0, 0, 0])
    assert meet(trainer, link)


def test_all_go_by_the_clock_of_the_first(tiny_scene: Path) -> None:
    trainer, link = trainer_of(tiny_scene, preset_of("training.budget=100s")), Scripted()
    trainer.clock.before = 40.0
    meet(trainer, link)
    trainer.clock.before = 90.0  # time goes on, but not within a step
    assert trainer.clock.progress == pytest.approx(0.4) and trainer.clock.now == 90.0


def test_different_models_are_an_error_that_names_step_and_ranks(trainer: Trainer) -> None:
    link = Scripted()
    trainer.clock.step = 200
    link.change = lambda row: row + torch.tensor([5.0, 0, 0, 0, 0, 1])
    with pytest.raises(RanksDifferError, match="at step 200 rank 1 and rank 0 hold other models"):
        meet(trainer, link)
    assert not trainer.is_sound  # and nothing of it is saved
    link.change = lambda row: row + torch.tensor([5.0, 0, 1, 0, 0, 0])
    with pytest.raises(RanksDifferError, match="hold at other steps"):
        meet(trainer, link)


def test_the_model_is_compared_after_every_resize_and_now_and_then(trainer: Trainer) -> None:
    link = Scripted()
    ranks = Connected(cast(Link, cast(Any, link)))
    for step in (0, 1, CHECK_EVERY - 1, CHECK_EVERY, CHECK_EVERY + 1):
        trainer.clock.step = step
        ranks.meet(trainer.clock, trainer.model, trainer.generator, False)
    trainer.model.take(torch.tensor([0, 1, 1]), torch.tensor([False, False, True]))
    ranks.meet(trainer.clock, trainer.model, trainer.generator, False)
    compared = [bool(row[5]) for row in link.sent]
    assert compared == [True, False, False, True, False, True]


def test_the_checksum_is_of_every_value_and_of_the_random_state(trainer: Trainer) -> None:
    def checksum() -> int:
        return checksum_of(trainer.model, trainer.generator)

    seen = {checksum()}
    for tensor in trainer.model.tensors().values():
        if tensor.numel():
            with torch.no_grad():
                tensor.view(-1)[-1] += 1
            assert checksum() not in seen
            seen.add(checksum())
    torch.rand((), generator=trainer.generator)
    assert checksum() not in seen


@pytest.mark.parametrize(("views", "ranks", "most"), [(2, 1, 2), (3, 2, 2), (4, 4, 1)])
def test_the_busiest_rank(views: int, ranks: int, most: int) -> None:
    assert most_of(views, ranks) == most
