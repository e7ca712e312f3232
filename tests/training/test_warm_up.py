"""Warming up: afterwards a training meets no kernel for the first time."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from training_checks import OPTIONS, STEPS, preset_of, trainer_of

from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.training.losses import Seen
from gsdmsr_cli.training.losses.flow import Flow
from gsdmsr_cli.training.warm_up import warm_up, warm_up_motion

IN_A_NEW_PROCESS = """
import importlib, json, sys
from pathlib import Path
import gsdmsr_cli
from gsdmsr_cli.backends.cpu.jit import sources
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.training.trainer import Trainer
from gsdmsr_cli.training.losses import Seen
from gsdmsr_cli.training.losses.flow import Flow
from gsdmsr_cli.training.warm_up import warm_up, warm_up_motion

def compiled():
    found = {}
    package = Path(gsdmsr_cli.__file__).parent
    for path in sources():
        if path.name.startswith("__"):
            continue
        module = ".".join(path.relative_to(package.parent).with_suffix("").parts)
        for name, value in vars(importlib.import_module(module)).items():
            if hasattr(value, "overloads"):
                found[f"{module}.{name}".removeprefix("gsdmsr_cli.ops.")] = len(value.overloads)
    return found

scene, options = read_scene(Path(sys.argv[1])), json.loads(sys.argv[2])
preset, engine, stages = load_preset("dnerf", None, options), best_engine("cpu"), []
warm_up_motion(scene, preset, engine)
stages.append(compiled())
warm_up(scene, preset, engine)
stages.append(compiled())
trainer = Trainer(scene, preset, engine, Pictures((1.0, 1.0, 1.0), 1, 1 << 24))
for _ in range(int(sys.argv[3])):
    trainer.step()
stages.append(compiled())
print(json.dumps(stages))
"""


@pytest.mark.parametrize("motion", ["multiscale", "hexplane", "control_points"])
def test_training_needs_no_kernel_that_was_not_warmed_up(tiny_scene: Path, motion: str) -> None:
    options = json.dumps([*OPTIONS, f"motion={{name: {motion}}}"])
    command = [sys.executable, "-c", IN_A_NEW_PROCESS, str(tiny_scene), options, str(STEPS)]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    by_motion, by_all, trained = json.loads(ended.stdout)
    assert trained == by_all
    for kernel in ("planes.cpu.lookup", "planes.cpu.lookup_backward", "network.cpu.forward"):
        assert by_motion[kernel] == by_all[kernel] > 0
    assert by_motion["rasterize.cpu.fused.look"] == 0 < by_all["rasterize.cpu.fused.look"]


@pytest.mark.parametrize("warm", [warm_up, warm_up_motion])
def test_warming_up_leaves_the_random_state(tiny_scene: Path, warm: object) -> None:
    trainer = trainer_of(tiny_scene, preset_of())
    before = torch.random.get_rng_state()
    assert callable(warm)
    warm(trainer.scene, trainer.preset, best_engine("cpu"))
    assert torch.equal(torch.random.get_rng_state(), before)


def test_terms_that_compare_two_moments_of_a_camera_are_warmed_up(
    tiny_scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where it is not the scene's own cameras that say so."""
    learns: list[bool] = []
    compare = Flow.__call__

    def told(term: Flow, seen: Seen) -> torch.Tensor:
        value = compare(term, seen)
        learns.append(value.requires_grad)
        return value

    monkeypatch.setattr(Flow, "__call__", told)
    preset = preset_of("losses.terms=[{name: flow}]", "training.low_resolution_until=0")
    trainer = trainer_of(tiny_scene, preset)
    warm_up(trainer.scene, preset, best_engine("cpu"))
    assert any(learns)
