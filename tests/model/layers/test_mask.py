"""Masks hide what they are told to, learn as a factor of scale and opacity would, and shrink."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from kernel_checks import generator
from motion_checks import FACTS, disturbed, moved_by, splats_of, started
from seam_checks import assert_trains_the_same_in_all_ways
from training_checks import STEPS, preset_of, trainer_of

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model.layer import Instant, options_of
from gsdmsr_cli.model.layers import mask
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.training.trainer import check_plugins

COUNT = 6
LAYERS = "layers=[{name: mask, weight: 3.0, rate: [0.5, 0.5]}]"
EVENTS = "events=[density, opacity_reset, thinning, stillness, {name: masked, every: 5}]"


def masked(*logits: float) -> mask.Mask:
    layer = mask.start(mask.Options(), FACTS, splats_of(len(logits)), generator())
    with torch.no_grad():
        layer.logits.copy_(torch.tensor(logits))
    return layer


def test_it_begins_as_the_identity() -> None:
    splats = splats_of(COUNT)
    layer = mask.start(mask.Options(), FACTS, splats, generator())
    for name, tensor in moved_by(layer, splats, 0.3).tensors().items():
        assert torch.equal(tensor, splats.tensors()[name]), name


def test_splats_at_or_below_the_threshold_are_not_drawn() -> None:
    edge = math.log(0.01 / 0.99)
    layer, splats = masked(1.0, edge + 0.01, edge - 0.01, -9.0), splats_of(4)
    assert layer.kept().tolist() == [True, True, False, False]
    found = moved_by(layer, splats, 0.0).logit_opacities
    assert torch.equal(found[:2], splats.logit_opacities[:2])
    assert (found[2:].sigmoid() < 1e-9).all()


def test_gradients_are_those_of_a_factor_of_scale_and_opacity() -> None:
    """In float64, of the opacity and the scales times m, at m = 1 for the value."""
    layer, splats = masked(1.0, -2.0, 0.4), splats_of(3)
    moved = moved_by(layer, splats, 0.0)
    weights = torch.randn(3, 4, generator=generator(2))
    drawn = torch.cat([moved.log_scales.exp(), moved.logit_opacities.sigmoid()[:, None]], dim=1)
    (drawn * weights).sum().backward()
    logits = torch.tensor([1.0, -2.0, 0.4], dtype=torch.float64, requires_grad=True)
    m = logits.sigmoid()
    factor = (m - m.detach() + 1)[:, None]
    stored = torch.cat([splats.log_scales.exp(), splats.logit_opacities.sigmoid()[:, None]], dim=1)
    (factor * stored.double() * weights).sum().backward()
    assert layer.logits.grad is not None and logits.grad is not None
    torch.testing.assert_close(layer.logits.grad.double(), logits.grad, rtol=1e-4, atol=1e-6)


def test_the_penalty_is_the_weighted_mean_of_the_masks() -> None:
    layer = masked(1.0, -2.0, 0.4)
    found = layer.penalty(Moment(splats_of(3)), Instant(0.2), generator())
    expected = 4e-3 * sum(1 / (1 + math.exp(-logit)) for logit in (1.0, -2.0, 0.4)) / 3
    assert float(found.detach()) == pytest.approx(expected, rel=1e-5)


def test_it_is_applied_before_the_motion_and_once_for_all_times() -> None:
    """A motion that adds to log scales gets them from the mask, at whatever time."""
    splats = splats_of(COUNT)
    layer, motion = masked(1.0, -9.0, 1, 1, 1, -9.0), disturbed(started("hexplane", COUNT))
    asked = []
    layer.at = lambda moment, now, at=layer.at: (asked.append(now), at(moment, now))[1]  # type: ignore[method-assign]
    model = Model(splats, {"motion": motion, "layers.mask": layer})
    found = model.at_instants([model.instant(time) for time in (0.0, 0.4, 1.0)])
    assert len(asked) == 1
    for moment, time in zip(found, (0.0, 0.4, 1.0), strict=True):
        expected = moved_by(motion, moved_by(layer, splats, time), time)
        for name, tensor in expected.tensors().items():
            assert torch.equal(moment.splats.tensors()[name], tensor), name


def test_resize_then_mask_is_mask_then_resize() -> None:
    layer, splats, rows = masked(1.0, -9.0, 2.0), splats_of(3), torch.tensor([2, 1, 1, 0])
    expected = moved_by(layer, splats, 0.3).take(rows)
    layer.take(rows, torch.zeros(4, dtype=torch.bool))
    for name, tensor in moved_by(layer, splats.take(rows), 0.3).tensors().items():
        assert torch.equal(tensor, expected.tensors()[name]), name


def test_masked_splats_are_removed_and_a_training_is_the_same_in_all_ways(
    tiny_scene: Path, tmp_path: Path
) -> None:
    trainer = assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, LAYERS, EVENTS)
    plain = trainer_of(tiny_scene, preset_of("training.views_per_step=2"))
    for _ in range(STEPS):
        plain.step()
    assert 0 < len(trainer.model.splats) < len(plain.model.splats)


def test_the_event_needs_the_layer_and_leaves_a_splat(tiny_scene: Path) -> None:
    with pytest.raises(UsageError, match=r"^events names 'masked', but layers has no 'mask'; add"):
        check_plugins(preset_of(EVENTS))
    trainer = trainer_of(tiny_scene, preset_of(LAYERS, EVENTS))
    with torch.no_grad():
        trainer.model.tensors()["layers.mask.logits"].fill_(-20.0)
    for _ in range(6):
        trainer.step()
    assert len(trainer.model.splats) > 0


@pytest.mark.parametrize(
    ("option", "value", "allowed"),
    [
        ("weight", -1, "0 or more"),
        ("threshold", 0, "above 0, below 0.5"),
        ("rate", [0, 1], r"\[start, end\], both above 0"),
    ],
)
def test_bad_options_are_refused(option: str, value: object, allowed: str) -> None:
    with pytest.raises(UsageError, match=f"layers: {option} is .*; allowed: {allowed}$"):
        options_of("gsdmsr_cli.model.layers", {"name": "mask", option: value})
