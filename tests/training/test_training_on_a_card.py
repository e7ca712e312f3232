"""Trainings on a GPU, where there is one: every preset makes its steps, and leaves a model behind.

Losses by the kernels are held to those of the CPU engine in ``test_training_on_cuda``, which needs
no card. Here whatever lies on the wrong device, or is asked of a device that lacks it, fails.
"""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from stream_checks import OPTIONS as OF_STREAMS
from stream_checks import WAYS, through
from training_checks import assert_same_tensors

from gsdmsr_cli.backends.cuda import availability
from gsdmsr_cli.drawing.splatting import draw
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.options.preset import Preset, load_preset
from gsdmsr_cli.options.preset_files import preset_names
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.training.streaming.trainer import StreamTrainer
from gsdmsr_cli.training.trainer import Trainer

DEVICE, STEPS = "cuda", 60

OPTIONS = (
    f"training.steps={STEPS}", "splats.count=300", "splats.start=box", "density.start=6",
    "density.every=6", "density.until=0.6", "density.cap=500", "saliency.still_every=5",
)  # fmt: skip
"""Every phase of a training, but for what presets say of their own."""

pytestmark = pytest.mark.skipif(
    availability.missing() is not None, reason=availability.missing() or ""
)


def pictures_of(preset: Preset) -> Pictures:
    return Pictures((1.0, 1.0, 1.0), preset.data.downscale, 1 << 24)


@pytest.mark.parametrize("name", [name for name in preset_names() if name not in WAYS])
def test_every_preset_trains_and_goes_on(tiny_scene: Path, name: str) -> None:
    preset, scene = load_preset(name, None, OPTIONS), read_scene(tiny_scene)
    engine = best_engine(DEVICE)

    def trainer() -> Trainer:
        return Trainer(scene, preset, engine, pictures_of(preset), DEVICE)

    with trainer() as first:
        losses = [first.step().loss for _ in range(STEPS)]
        assert all(math.isfinite(float(loss)) for loss in losses)
        view, model = scene.split("test")[0], first.result()
        background = torch.ones(3, device=DEVICE)
        drawn = draw(model, view.camera, view.time, engine, background).rgb
        assert drawn.isfinite().all() and drawn.std() > 0
        kept = first.checkpoint()
    with trainer() as second:
        second.restore(kept)
        assert_same_tensors(second.model.tensors(), first.model.tensors())
        assert math.isfinite(float(second.step().loss))


@pytest.mark.parametrize("way", WAYS)
def test_every_way_of_streaming_goes_from_moment_to_moment(rig: Path, way: str) -> None:
    preset, scene = load_preset(way, None, OF_STREAMS), read_scene(rig)
    with StreamTrainer(scene, preset, best_engine(DEVICE), pictures_of(preset), DEVICE) as trainer:
        through(trainer, 2)
        assert all(tensor.isfinite().all() for tensor in trainer.model.trained().values())
