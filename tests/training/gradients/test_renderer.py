"""Rendering views in training: some of their pixels may not count."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from datasets import noise, write_picture
from seam_checks import assert_trains_the_same_in_all_ways
from training_checks import STEPS, counted_ways_back, preset_of, trainer_of

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.model.model import STORED_AS, Model
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.pictures import HalvedPictures, Pictures
from gsdmsr_cli.scene.scene import MASK, MOVING, View
from gsdmsr_cli.training.gradients.phase import Order, Phase
from gsdmsr_cli.training.gradients.renderer import TrainingRenderer
from gsdmsr_cli.training.trainer import Trainer

BACKGROUND = torch.tensor([1.0, 1.0, 1.0])


@pytest.fixture
def trainer(tiny_scene: Path) -> Trainer:
    return trainer_of(tiny_scene, preset_of())


def test_a_term_may_count_in_some_steps_and_then_as_many_times(
    tiny_scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    terms = "[{name: inverse_depth, factor: 0.1, every: 3}, {name: isometry, factor: 0.2}]"
    trainer = trainer_of(tiny_scene, preset_of(f"losses.terms={terms}"))
    seen, weights = [], TrainingRenderer._weights

    def noted(renderer: TrainingRenderer, phase: Phase) -> list[float]:
        seen.append(weights(renderer, phase))
        return seen[-1]

    monkeypatch.setattr(TrainingRenderer, "_weights", noted)
    for step in range(5):
        seen.clear()
        trainer.step()
        assert seen and all(w == pytest.approx([0 if step % 3 else 0.3, 0.2]) for w in seen), step


@pytest.mark.parametrize("progress", [0.0, 0.9])
def test_training_leaves_out_what_masks_leave_out(
    trainer: Trainer, tmp_path: Path, progress: float
) -> None:
    """At half the size, with SSIM, and at the full size without."""
    mask = (np.arange(48) < 24)[None].repeat(48, axis=0)
    write_picture(tmp_path / "mask.png", (255 * mask).astype(np.uint8)[..., None])
    view = replace(trainer.views[0], signals={MASK: tmp_path / "mask.png"})
    phase = Phase(progress, moving=False)
    renderer, model = trainer.renderer, trainer.model
    drawn = best_engine("cpu").rasterize(Moment(model.splats), view.camera, BACKGROUND).means2d
    (whole,) = renderer.gradients(model, [Order(0)], phase)
    renderer.views = [view]
    (masked,) = renderer.gradients(model, [Order(0)], phase)
    left = drawn[:, 0] < 10  # whose splats reach into the half that counts
    far_right = drawn[:, 0] > 44
    assert masked.on_screen[left].any()
    assert not masked.on_screen[far_right & (model.splats.log_scales.exp() < 0.05).all(1)].any()
    assert masked.loss < whole.loss


@pytest.mark.parametrize("progress", [0.0, 0.9])
def test_what_moves_by_a_mask_counts_more(
    tiny_scene: Path, tmp_path: Path, progress: float
) -> None:
    """At half the size, with SSIM, and at the full size without; other views count as before."""
    preset = preset_of("losses.moving_weight=2", "training.low_resolution_until=0.5")
    trainer = trainer_of(tiny_scene, preset)
    renderer, model, phase = trainer.renderer, trainer.model, Phase(progress, moving=False)
    assert renderer.renders_at_once(model), "no view has a mask yet"
    (plain,) = renderer.gradients(model, [Order(0)], phase)
    for share, expected in ((48, 3.0), (0, 1.0)):
        mask = (np.arange(48) < share)[None].repeat(48, axis=0)
        path = tmp_path / f"{share}.png"
        write_picture(path, (255 * mask).astype(np.uint8)[..., None])
        renderer.views = [replace(trainer.views[0], signals={MOVING: path})]
        assert not renderer.renders_at_once(model)
        (found,) = renderer.gradients(model, [Order(0)], phase)
        assert found.loss.item() == pytest.approx(expected * plain.loss.item(), rel=1e-3)


def test_half_the_size_counts_where_half_of_the_pixels_do(tmp_path: Path) -> None:
    mask = np.zeros((4, 6, 1), np.uint8)
    mask[0, 0] = 255  # a quarter
    mask[2, :2] = 255  # a half
    mask[2:, 4:] = 255
    write_picture(tmp_path / "a.png", noise(4, 6, 3))
    write_picture(tmp_path / "mask.png", mask)
    camera = Camera(np.eye(4), 5.0, 5.0, 3.0, 2.0, 6, 4)
    signals = {MASK: tmp_path / "mask.png"}
    view = View("a", camera, 0.0, "train", tmp_path / "a.png", signals)
    pictures = HalvedPictures(Pictures((1.0, 1.0, 1.0), 1, 1 << 20))
    counted = pictures.signal(view, MASK)
    assert counted is not None
    assert counted.tolist() == [[False, False, False], [True, False, True]]
    assert pictures.signal(replace(view, signals={}), MASK) is None


def test_what_counts_by_its_square_trains_the_same_in_all_ways(
    tiny_scene: Path, tmp_path: Path
) -> None:
    options = "{quadratic: 0.1, quadratic_from: 0, ssim: 0.2, ssim_until: 0.5}"
    assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, f"losses={options}")


def test_terms_cost_no_further_way_back_through_the_picture(
    tiny_scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    times = counted_ways_back(monkeypatch)
    found = {}
    for terms in ("[]", "[{name: temporal_smoothness, factor: 100.0}]"):
        trainer = trainer_of(tiny_scene, preset_of(f"losses.terms={terms}"))
        trainer.population.begin_moving()
        rng = torch.Generator().manual_seed(1)
        with torch.no_grad():  # motions begin as none
            for name, tensor in trainer.model.trained().items():
                if not name.startswith(STORED_AS):
                    tensor += 0.01 * torch.randn(tensor.shape, generator=rng)
        others = trainer.renderer.other_times(trainer.views[0], [0.0, 1.0], trainer.generator)
        times.clear()
        phase = Phase(0.9, moving=True)
        order = Order(0, other_times=others)
        (found[terms],) = trainer.renderer.gradients(trainer.model, [order], phase)
        assert len(times) == 1
    without, held = found.values()
    assert float(held.loss) > float(without.loss)
    assert torch.equal(held.on_screen, without.on_screen)


def test_those_on_the_screen_are_asked_for_while_splats_grow_or_are_gated(
    tiny_scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[float, bool]] = []
    gradients = TrainingRenderer.gradients

    def remember(self: TrainingRenderer, model: Model, orders: list[Order], phase: Phase) -> Any:
        asked.append((phase.progress, phase.screens))
        return gradients(self, model, orders, phase)

    monkeypatch.setattr(TrainingRenderer, "gradients", remember)
    for gate, since in (("none", 1.0), ("scale", 0.7)):
        asked.clear()
        options = ("density.until=0.4", f"saliency.gate={gate}", "saliency.gate_from=0.7")
        trainer = trainer_of(tiny_scene, preset_of(*options))
        for _ in range(STEPS):
            trainer.step()
        assert asked[-1][0] > 0.7
        assert asked == [(progress, progress < 0.4 or progress >= since) for progress, _ in asked]


def test_terms_of_canonical_splats_move_nothing_else(tiny_scene: Path) -> None:
    """Such a term would drag the motion along, which is what the pictures are to teach."""
    found = {}
    for terms in ("[]", "[{name: inverse_depth, factor: 1.0}]"):
        trainer = trainer_of(tiny_scene, preset_of(f"losses.terms={terms}"))
        trainer.population.begin_moving()
        phase = Phase(0.9, moving=True)
        (one,) = trainer.renderer.gradients(trainer.model, [Order(0)], phase)
        found[terms] = dict(zip(trainer.model.trained(), one.gradients, strict=True)), one.loss
    (without, loss), (pushed, more) = found.values()
    assert float(more) != float(loss)
    for name, gradient in without.items():
        other = pushed[name]
        if gradient is None or other is None:
            assert gradient is other, name
            continue
        same = torch.allclose(gradient, other, rtol=1e-3, atol=1e-6 * float(gradient.abs().max()))
        if name.endswith((".means", ".logit_opacities")):
            assert not same, name
        elif not name.startswith(STORED_AS):
            assert same, name
