"""Runs are drawn at other sizes as they look at the size of their training."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from training_checks import run_of, trainer_of

from gsdmsr_cli.commands._trained import open_trained
from gsdmsr_cli.options.preset import load_preset


@pytest.mark.parametrize("trained_at", [1, 2])
def test_smaller_views_are_means_of_those_of_training(
    tiny_scene: Path, tmp_path: Path, trained_at: int
) -> None:
    options = "splats.count=200", "splats.start=box", "splats.opacity=0.9"
    trainer = trainer_of(
        tiny_scene, load_preset("dnerf", None, [*options, f"data.downscale={trained_at}"])
    )
    made = run_of(trainer, tmp_path / "run")
    with torch.no_grad():
        trainer.model.splats.log_scales.sub_(2)
    made.save(trainer.checkpoint())
    view = trainer.scene.split("test")[0]
    with open_trained(made.root, None) as opened:
        whole = opened.renderer.draw(view)
    with open_trained(made.root, None, downscale=2 * trained_at) as opened:
        half = opened.renderer.draw(view)
    height, width, _ = half.shape
    assert whole.shape == (2 * height, 2 * width, 3)
    assert whole.std() > 0.01, "something is seen"
    torch.testing.assert_close(half, whole.reshape(height, 2, width, 2, 3).mean(dim=(1, 3)))
