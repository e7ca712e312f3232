"""A short training on the tiny scene, for tests of the trainer, its loop and its run folder.

And a run that has made no step, for tests of commands that take one.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.options.preset import Preset, load_preset
from gsdmsr_cli.raster import Engine, best_engine
from gsdmsr_cli.runs.beginning import create_run
from gsdmsr_cli.runs.run import Run
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.training.trainer import Trainer

STEPS = 40

OPTIONS = (
    f"training.steps={STEPS}", "training.static_until=0.1", "training.views_per_step=1",
    "splats.count=120", "splats.start=box", "splats.sh_start=0.5",
    "density.start=6", "density.every=6", "density.until=0.8", "density.gradient=1e-7",
    "density.cap=200", "density.reset_at=[0.4]", "density.thin_at=[]",
    "optimizer.log_scales=[5e-3,2e-3]",
)  # fmt: skip
"""Every phase of a training within 40 steps: static, coarse, fine; growing, a reset, pruning."""


SETTLING = (
    "density.until=0.4", "saliency.still_from=0.5", "saliency.still_every=5",
    "optimizer.planes=[0.05,0.01]", "optimizer.network=[0.02,0.002]",
)  # fmt: skip
"""A field that learns fast; at half of the steps some splats move and some do not."""


def preset_of(*options: str, motion: str = "multiscale") -> Preset:
    return load_preset("dnerf", None, [*OPTIONS, f"motion={{name: {motion}}}", *options])


def trainer_of(data: Path, preset: Preset, engine: Engine | None = None) -> Trainer:
    pictures = Pictures((1.0, 1.0, 1.0), preset.data.downscale, 1 << 24)
    return Trainer(read_scene(data), preset, engine or best_engine("cpu"), pictures)


def counted_ways_back(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return a list that grows by one entry whenever gradients are taken."""
    times: list[int] = []
    grad = torch.autograd.grad

    def counted(*given: Any, **options: Any) -> Any:
        times.append(1)
        return grad(*given, **options)

    monkeypatch.setattr(torch.autograd, "grad", counted)
    return times


def run_of(trainer: Trainer, root: Path) -> Run:
    return create_run(root, "dnerf", trainer.preset, trainer.facts, trainer.scene)


def begun_run(
    data: Path,
    root: Path,
    options: Sequence[str],
    preset: str = "dnerf",
    reason: str | None = None,
    verify: bool = False,
) -> Run:
    """Make a run that has made no step."""
    trainer = trainer_of(data, load_preset(preset, None, options))
    about = trainer.preset, trainer.facts, trainer.scene
    run = create_run(root, preset, *about, reason=reason, verify=verify)
    run.save(trainer.checkpoint())
    return run


def copies(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: tensor.detach().clone() for name, tensor in tensors.items()}


def assert_same_tensors(found: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    assert found.keys() == expected.keys()
    for name, tensor in expected.items():
        assert torch.equal(found[name], tensor), name


def per_splat(model: Model) -> list[str]:
    """Return the names of the tensors with rows of splats: of all, or of those that move."""
    return [parameter.name for parameter in model.parameters() if parameter.per_splat]
