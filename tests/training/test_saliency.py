"""MS-DGO: what counts as salient, when a splat changes its class, and what the gate does."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from kernel_checks import generator
from motion_checks import splats_of
from torch import Tensor
from torch.nn.functional import normalize
from training_checks import (
    SETTLING,
    STEPS,
    assert_same_tensors,
    copies,
    preset_of,
    run_of,
    trainer_of,
)

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.options.preset import SaliencyOptions
from gsdmsr_cli.training.rates import learning_rates
from gsdmsr_cli.training.saliency import SPARSE_EVERY, Saliency, step_saliency
from gsdmsr_cli.training.trainer import Trainer

ALL = torch.tensor([True])
GATED = (
    "density.until=0.3", "saliency.gate_from=0.2", "saliency.smoothing=0", "saliency.hold=0",
    "saliency.grace=0",
)  # fmt: skip
NEVER_HIGH = "saliency.threshold=1e9"


def steps_of(splats: Splats, size: float = 0.01) -> dict[str, Tensor]:
    rng = generator(3)
    return {
        name: size * torch.randn(tensor.shape, generator=rng)
        for name, tensor in splats.tensors().items()
    }


def test_saliency_is_the_weighted_length_of_the_step() -> None:
    """|W (a(t) - a(t - 1))|_1, term by term: 1 / (12 size), 1 / 12, 1 / 16 and C0 / 12."""
    now = splats_of(6)
    steps = steps_of(now)
    before = Splats(**{name: tensor + steps[name] for name, tensor in now.tensors().items()})
    expected = []
    for i in range(6):
        size = math.exp(float(now.log_scales[i].mean()))
        turn = normalize(now.quats[i], dim=0) - normalize(before.quats[i], dim=0)
        colour = now.sh[i, 0] - before.sh[i, 0]
        expected.append(
            float((now.means[i] - before.means[i]).abs().sum()) / (12 * size)
            + float((now.log_scales[i] - before.log_scales[i]).abs().sum()) / 12
            + float(turn.abs().sum()) / 16
            + float(colour.abs().sum()) * SH_C0 / 12
        )
    found = step_saliency(now, steps)
    torch.testing.assert_close(found, torch.tensor(expected), atol=1e-6, rtol=1e-3)


def test_raw_saliency_adds_up_all_components_as_stored() -> None:
    """W = 1 on x, r, s, c, as the algorithm of the method's summary is written; no opacity."""
    splats = splats_of(4)
    steps = {name: torch.full_like(tensor, -0.5) for name, tensor in splats.tensors().items()}
    components = 3 + 4 + 3 + 12
    torch.testing.assert_close(step_saliency(splats, steps, raw=True), torch.full((4,), 11.0))
    assert components * 0.5 == 11.0


def saliency_of(count: int = 1, **options: float | str) -> Saliency:
    settings = {"gate": "freeze", "smoothing": 0.0, "hold": 0, "grace": 0} | options
    return Saliency(count, SaliencyOptions(**settings))  # type: ignore[arg-type]


def classes(saliency: Saliency, scores: Sequence[float]) -> list[bool]:
    """Return the class after each step of a single splat."""
    found = []
    for score in scores:
        saliency.observe(torch.tensor([score]), ALL)
        found.append(bool(saliency.high))
    return found


@pytest.mark.parametrize("quantile, low", [(0.3, 2), (0.5, 4), (1.0, 9)])
def test_a_quantile_makes_that_share_of_the_splats_low(quantile: float, low: int) -> None:
    """Scores 1 to 10: those below the k-th smallest are low, whatever the threshold."""
    scores = torch.randperm(10, generator=generator(2)) + 1.0
    saliency = saliency_of(10, threshold=1e9, quantile=quantile, release=1.0)
    saliency.observe(scores, torch.ones(10, dtype=torch.bool))
    assert (~saliency.high).tolist() == [score <= low for score in scores.tolist()]


def test_between_release_and_threshold_the_class_stays() -> None:
    saliency = saliency_of(threshold=1.0, release=0.5)
    scores = [0.7, 0.4, 0.7, 0.9, 1.1, 0.6, 0.49]
    assert classes(saliency, scores) == [True, False, False, False, True, True, False]


def test_a_class_is_held() -> None:
    saliency = saliency_of(threshold=1.0, hold=3)
    found = classes(saliency, [0.0] * 4 + [2.0] * 5)
    assert found == [True, True, True, False, False, False, False, True, True]


def test_new_splats_have_grace_and_so_have_restarted_ones() -> None:
    saliency = saliency_of(threshold=1.0, grace=2)
    assert classes(saliency, [0.0, 0.0]) == [True, False]
    saliency.restart(ALL)
    assert bool(saliency.high)
    assert classes(saliency, [0.0, 0.0]) == [True, False]
    saliency.take(torch.tensor([0, 0]), torch.tensor([False, True]))
    assert saliency.high.tolist() == [False, True]
    saliency.observe(torch.zeros(2), torch.tensor([True, True]))
    assert saliency.high.tolist() == [False, True]


def test_what_begins_anew_is_held_as_long_as_what_is_new() -> None:
    saliency = saliency_of(threshold=1.0, hold=3)
    assert classes(saliency, [0.0] * 9)[3:] == [False] * 6  # low, and old enough to change again
    saliency.restart(ALL)
    assert classes(saliency, [0.0] * 4) == [True, True, True, False]


def test_scores_are_smoothed_over_the_steps_that_saw_the_splat() -> None:
    saliency = saliency_of(2, threshold=1.0, smoothing=0.9)
    saliency.observe(torch.tensor([3.0, 3.0]), torch.tensor([True, False]))
    torch.testing.assert_close(saliency.scores, torch.tensor([0.9 + 0.3, 1.0]))
    saliency.observe(torch.tensor([math.nan, math.inf]), torch.tensor([True, True]))
    torch.testing.assert_close(saliency.scores, torch.tensor([1.2, 1.0]))


def test_who_rises_is_told() -> None:
    saliency = saliency_of(3, threshold=1.0)
    saliency.observe(torch.tensor([0.0, 0.0, 2.0]), torch.ones(3, dtype=torch.bool))
    woken = saliency.observe(torch.tensor([2.0, 0.0, 2.0]), torch.ones(3, dtype=torch.bool))
    assert woken.tolist() == [True, False, False]


@pytest.mark.parametrize(
    ("gate", "factors"),
    [("scale", [0.25] * 9), ("freeze", [0] * 9), ("sparse", [1] + [0] * 7 + [1])],
)
def test_what_low_splats_may_do(gate: str, factors: list[float]) -> None:
    saliency = saliency_of(2, gate=gate, low_rate=0.25)
    saliency.high = torch.tensor([True, False])
    assert SPARSE_EVERY == 8
    for step, factor in enumerate(factors):
        assert saliency.multipliers(step).tolist() == [1.0, factor]


def test_fields_learn_from_low_splats_now_and_then() -> None:
    saliency = saliency_of(2, field_every=3)
    saliency.high = torch.tensor([True, False])
    found = [saliency.gradient_mask(step) for step in range(4)]
    assert found[0] is None and found[3] is None
    assert found[1] is saliency.high and found[2] is saliency.high


def gated(data: Path, *options: str, motion: str = "multiscale") -> Trainer:
    return trainer_of(data, preset_of(*GATED, *options, motion=motion))


def after(trainer: Trainer, steps: int) -> Trainer:
    for _ in range(steps):
        trainer.step()
    return trainer


def judged(trainer: Trainer) -> Tensor:
    """Return which splats have been seen since they are gated."""
    return trainer.saliency.scores != trainer.preset.saliency.threshold


def test_frozen_splats_do_not_change_by_a_bit_and_may_wake_up(tiny_scene: Path) -> None:
    trainer = after(gated(tiny_scene, "saliency.gate=freeze", NEVER_HIGH), 20)
    low = ~trainer.saliency.high
    assert low.sum() > 20
    names = [name for name in trainer.checkpoint().tensors if "splats." in name]

    def frozen() -> dict[str, Tensor]:
        tensors = trainer.checkpoint().tensors
        return copies({name: tensors[name][low] for name in names})

    own, scores = frozen(), trainer.saliency.scores.clone()
    after(trainer, 3)
    assert len(names) == 15  # values and both moments
    assert_same_tensors(frozen(), own)
    changed = trainer.saliency.scores != scores
    assert changed[low].any()  # worked out from what they would have done

    woken = low.nonzero().flatten()[:5]
    trainer.saliency.scores[:] = 0.0
    trainer.saliency.scores[woken] = 1.0
    trainer.saliency.options = replace(trainer.saliency.options, threshold=0.5, smoothing=0.999999)
    before = trainer.model.splats.means.detach().clone()
    trainer.step()
    assert trainer.saliency.high[woken].all()
    assert not trainer.optimizer.first["splats.means"][woken].any()
    after(trainer, 4)
    moved = (trainer.model.splats.means != before).any(dim=1)
    assert moved[woken].any()


def test_scaled_splats_move_by_the_share(tiny_scene: Path) -> None:
    """From the same state, one step with everything low against one with everything high."""
    free = after(gated(tiny_scene, "saliency.gate=scale", "saliency.threshold=1e-9"), 12)
    slow = gated(tiny_scene, "saliency.gate=scale", "saliency.threshold=1e-9")
    checkpoint = free.checkpoint()
    slow.restore(replace(checkpoint, tensors=copies(checkpoint.tensors)))
    slow.saliency.high = torch.zeros_like(free.saliency.high)
    assert free.saliency.high.all()
    before = free.model.splats.means.detach().clone()
    free.step(), slow.step()
    moved = [trainer.model.splats.means.detach() - before for trainer in (free, slow)]
    assert moved[0].abs().max() > 1e-4
    torch.testing.assert_close(moved[1], 0.01 * moved[0], atol=2e-7, rtol=1e-3)


@pytest.mark.parametrize("gate", ["scale", "freeze", "sparse"])
def test_a_gate_that_never_closes_changes_nothing(tiny_scene: Path, gate: str) -> None:
    """To a hundredth of a step, which is as long as the rate: sums are in another order.

    Where a gradient is all but cancelled, its rounding errors make up much of it, and Adam divides
    by its size; a step that were scaled or left out would differ by 0.99 of it at least.
    """
    open_gate = after(gated(tiny_scene, f"saliency.gate={gate}", "saliency.threshold=1e-12"), 25)
    none = after(gated(tiny_scene), 25)
    rates = learning_rates(
        none.model.parameters(), none.preset.optimizer, 1.0, none.preset.training.static_until,
        none.scene.radius,
    )  # fmt: skip
    for name, tensor in none.model.tensors().items():
        torch.testing.assert_close(
            open_gate.model.tensors()[name], tensor, atol=0.01 * rates[name], rtol=1e-5
        )


def test_nothing_is_gated_before_its_time(tiny_scene: Path) -> None:
    trainer = after(gated(tiny_scene, "saliency.gate=freeze", NEVER_HIGH), 8)
    assert trainer.saliency.high.all() and not judged(trainer).any()
    after(trainer, 1)
    assert torch.equal(~trainer.saliency.high, judged(trainer)) and judged(trainer).any()


def test_the_reset_of_opacities_restarts_all(tiny_scene: Path) -> None:
    trainer = gated(tiny_scene, "saliency.gate=freeze", NEVER_HIGH, "saliency.grace=4")
    after(trainer, 16)
    assert not trainer.saliency.high.all()
    after(trainer, 1)  # the reset is at 0.4
    assert trainer.saliency.high.all()
    assert (trainer.saliency.grace == 4).all()


@pytest.mark.parametrize("gate", ["scale", "freeze", "sparse"])
@pytest.mark.parametrize("stop", [9, 17, 26])
def test_a_resumed_training_is_gated_as_if_never_interrupted(
    tiny_scene: Path, tmp_path: Path, gate: str, stop: int
) -> None:
    """With splats in both classes, some standing still, and some that fields do not learn from."""
    options = (
        f"saliency.gate={gate}", "saliency.threshold=1.5e-4", "saliency.field_every=2", *SETTLING
    )  # fmt: skip
    whole = after(gated(tiny_scene, *options), STEPS)
    assert whole.saliency.high.any() and not whole.saliency.high.all()
    first = after(gated(tiny_scene, *options), stop)
    run = run_of(first, tmp_path / "run")
    run.save(first.checkpoint())
    second = gated(tiny_scene, *options)
    second.restore(run.load())
    after(second, STEPS - stop)
    assert_same_tensors(second.checkpoint().tensors, whole.checkpoint().tensors)
