"""Which tiles are learnt from, and that they stand for the whole picture."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_checks import generator
from torch import Tensor
from training_checks import STEPS, assert_same_tensors, copies, preset_of, run_of, trainer_of

from gsdmsr_cli.training.gradients.tiles import EVENLY, TileSampler
from gsdmsr_cli.training.trainer import Trainer

CHOSEN = ("losses.ssim=0", "training.tiles_per_view=2", "training.views_per_step=2")


def sampler_of(errors: list[float], count: int) -> TileSampler:
    sampler = TileSampler(count)
    sampler.errors[0] = torch.tensor(errors, dtype=torch.float64)
    return sampler


def mean_weights(sampler: TileSampler, tiles: int, looks: int = 4000) -> Tensor:
    rng = generator()
    return torch.stack([sampler.choose(0, tiles, rng) for _ in range(looks)]).mean(dim=0)


@pytest.mark.parametrize("errors", [[1.0, 2, 3, 50, 0, 0], [0.0] * 6, [float("nan"), 1, 4] * 2])
def test_weights_are_1_in_the_mean(errors: list[float]) -> None:
    """So the weighted loss is that of the whole picture in the mean, whatever is known.

    A weight is at most 2 tiles / count, so the mean of 4000 deviates by 0.05 at most (6 sigma).
    """
    sampler = sampler_of(errors, 3)
    torch.testing.assert_close(mean_weights(sampler, 6), torch.ones(6), atol=0.1, rtol=0)


@given(st.lists(st.floats(0, 1e3), min_size=2, max_size=30), st.integers(1, 8))
@settings(max_examples=50, deadline=None)
def test_no_weight_is_larger_than_of_an_even_choice_of_half_as_many(
    errors: list[float], count: int
) -> None:
    sampler, tiles = sampler_of(errors, count), len(errors)
    weights = sampler.choose(0, tiles, generator())
    assert 0 < int((weights > 0).sum()) <= count
    assert float(weights.max()) <= tiles / EVENLY * (1 + 1e-6)


def test_tiles_with_a_large_error_are_chosen_more_often() -> None:
    sampler, rng = sampler_of([9.0, 1.0, 0.0, 0.0], 1), generator()
    often = torch.stack([sampler.choose(0, 4, rng) > 0 for _ in range(4000)]).double().mean(dim=0)
    expected = torch.tensor([0.125 + 0.45, 0.125 + 0.05, 0.125, 0.125], dtype=torch.float64)
    torch.testing.assert_close(often, expected, atol=0.05, rtol=0)


def test_a_tile_not_seen_yet_counts_as_an_average_one() -> None:
    """Errors 1 and 3 are known, so the others count as 2; of a single draw the weight is 1 / q."""
    sampler, rng = sampler_of([float("nan"), 1.0, 3.0, float("nan")], 1), generator()
    found = torch.stack([sampler.choose(0, 4, rng) for _ in range(200)]).amax(dim=0)
    chances = torch.tensor([0.125 + 0.125, 0.125 + 0.0625, 0.125 + 0.1875, 0.125 + 0.125])
    torch.testing.assert_close(found, 1 / chances)


def test_only_what_has_been_drawn_is_learnt() -> None:
    sampler = TileSampler(2)
    sampler.learn(3, torch.tensor([0.0, 2.0, 1.0]), torch.tensor([0.0, 5.0, 7.0]).double())
    sampler.learn(3, torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.0, 0.0, 4.0]).double())
    known = torch.tensor([float("nan"), 5.0, 4.0], dtype=torch.float64)
    torch.testing.assert_close(sampler.errors[3], known, equal_nan=True)
    sampler.learn(3, torch.ones(2), torch.ones(2).double())  # a picture of another size
    assert len(sampler.errors[3]) == 2


def after(trainer: Trainer, steps: int) -> Trainer:
    for _ in range(steps):
        trainer.step()
    return trainer


def test_a_training_on_tiles_learns(tiny_scene: Path) -> None:
    options = (*CHOSEN, "training.steps=160", "splats.count=300", "density.reset_at=[]")
    options += "density.cap=400", "losses.quadratic=0"
    trainer = trainer_of(tiny_scene, preset_of(*options))
    losses = [trainer.step().loss for _ in range(160)]
    assert sum(losses[-40:]) < 0.7 * sum(losses[:40])


def test_whole_pictures_are_drawn_while_ssim_counts(tiny_scene: Path) -> None:
    options = ("training.tiles_per_view=1", "losses.ssim=0.2", "losses.ssim_until=0.5")
    trainer = after(trainer_of(tiny_scene, preset_of(*options)), STEPS // 2)
    assert not trainer.tiles.errors
    after(trainer, 1)
    assert trainer.tiles.errors


def test_more_tiles_than_there_are_is_the_whole_picture(tiny_scene: Path) -> None:
    many = after(
        trainer_of(tiny_scene, preset_of("losses.ssim=0", "training.tiles_per_view=99")), 9
    )
    whole = after(trainer_of(tiny_scene, preset_of("losses.ssim=0")), 9)
    assert_same_tensors(many.checkpoint().tensors, whole.checkpoint().tensors)


def test_the_statistic_of_density_is_that_of_the_tiles_drawn(tiny_scene: Path) -> None:
    """It does not rise with the weights; of all nine tiles it is that of the whole picture."""

    def statistic(weights: Tensor | None) -> Tensor:
        options = CHOSEN if weights is not None else ("losses.ssim=0", "training.views_per_step=2")
        trainer = trainer_of(tiny_scene, preset_of(*options, "training.low_resolution_until=0"))
        trainer.tiles.choose = lambda *_: weights  # type: ignore[method-assign]
        return after(trainer, 1).population.statistics.mean()

    middle = torch.arange(9) == 4
    light, heavy, every, whole = map(statistic, (middle * 0.5, middle * 9.0, torch.ones(9), None))
    assert torch.equal(light, heavy)
    torch.testing.assert_close(every, whole, rtol=1e-4, atol=1e-7)
    assert 0 < int((light > 0).sum()) < int((whole > 0).sum())


@pytest.mark.parametrize("stop", [7, 23])
def test_a_resumed_training_chooses_the_same_tiles(
    tiny_scene: Path, tmp_path: Path, stop: int
) -> None:
    options = (*CHOSEN, "training.low_resolution_until=0.3")
    whole = after(trainer_of(tiny_scene, preset_of(*options)), STEPS)
    first = after(trainer_of(tiny_scene, preset_of(*options)), stop)
    run = run_of(first, tmp_path / "run")
    run.save(first.checkpoint())
    second = trainer_of(tiny_scene, preset_of(*options))
    second.restore(run.load())
    after(second, STEPS - stop)
    found, expected = (copies(t.checkpoint().tensors) for t in (second, whole))
    assert found.keys() == expected.keys()
    for name, tensor in expected.items():
        torch.testing.assert_close(found[name], tensor, atol=0, rtol=0, equal_nan=True)
