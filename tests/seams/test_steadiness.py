"""A loss between two moments, in one file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from seam_checks import assert_trains_the_same_in_all_ways
from torch import Tensor
from training_checks import STEPS, preset_of, trainer_of

from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.scene.scene import View
from gsdmsr_cli.training.losses import Seen, Term
from gsdmsr_cli.training.trainer import Trainer, check_plugins


@dataclass(frozen=True)
class Options:
    """Settings: the factor of the term."""

    factor: float = 1.0


class Steadiness(Term):
    """The mean squared way of the splats from the view's moment to another one."""

    def __init__(self, options: Options) -> None:
        self.factor = options.factor

    def weight(self, progress: float) -> float:
        return self.factor

    def other_time(
        self, view: View, times: Sequence[float], generator: torch.Generator
    ) -> float | None:
        return times[int(torch.randint(len(times), (), generator=generator))]

    def __call__(self, seen: Seen) -> Tensor:
        assert seen.other is not None and seen.other_instant is not None
        return (seen.moment.splats.means - seen.other.splats.means).square().sum(dim=1).mean()


def start(options: Options) -> Steadiness:
    return Steadiness(options)


def options(factor: float) -> tuple[str, ...]:
    terms = f"losses.terms=[{{name: test_steadiness, factor: {factor}}}]"
    return (terms, "optimizer.planes=[0.05,0.01]", "optimizer.network=[0.02,0.002]")


def way(trainer: Trainer) -> float:
    """Return how far splats go from the first moment to the last, in the mean."""
    for _ in range(STEPS):
        trainer.step()
    model = trainer.model
    first, last = (model.at(model.instant(time)).splats.means for time in (0.0, 1.0))
    return float((first - last).detach().norm(dim=1).mean())


def test_it_trains_with_workers_without_and_resumed(tiny_scene: Path, tmp_path: Path) -> None:
    assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, *options(0.5))


def test_the_more_it_counts_the_less_splats_move(tiny_scene: Path) -> None:
    loose, tight = (way(trainer_of(tiny_scene, preset_of(*options(f)))) for f in (0.0, 100.0))
    assert 0 < tight < 0.5 * loose


def test_a_term_without_weight_changes_nothing(tiny_scene: Path) -> None:
    """But for the second times, which are drawn by chance; so chance is to be spent alike."""
    plain, unweighted = (
        trainer_of(tiny_scene, preset_of(*given, "training.views_per_step=1"))
        for given in (options(0.0)[1:], options(0.0))
    )
    unweighted.renderer.other_times = lambda *_: (None,)  # type: ignore[method-assign]
    for trainer in (plain, unweighted):
        for _ in range(STEPS):
            trainer.step()
    for name, tensor in plain.model.tensors().items():
        assert torch.equal(tensor, unweighted.model.tensors()[name]), name


def test_an_unknown_option_of_a_term_is_told() -> None:
    with pytest.raises(UsageError, match=r"unknown key 'facter'; did you mean 'factor'\?"):
        check_plugins(preset_of("losses.terms=[{name: test_steadiness, facter: 2}]"))
