"""A layer that wants to know the camera, in one file: splats are brighter from one side."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from seam_checks import assert_trains_the_same_in_all_ways
from torch import Tensor
from training_checks import SETTLING, STEPS, preset_of, trainer_of

from gsdmsr_cli.exports import export
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.options.strict import Located
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.training.warm_up import warm_up_motion


@dataclass(frozen=True)
class Options:
    """None."""


RATE = 0.02, 0.002


class Glossy(Layer):
    """Adds to all colours a number that is linear in the direction of the camera."""

    concerns_still = True
    needs_camera = True

    def __init__(self) -> None:
        self.slope, self.gain = torch.zeros(3), torch.zeros(())
        parameters = (
            Parameter("slope", self.slope, rate=(0.02, 0.002)),
            Parameter("gain", self.gain, rate=(0.02, 0.002)),
        )
        super().__init__(parameters)

    def at(self, moment: Moment, instant: Instant) -> Moment:
        shine = self.gain + self._direction(instant.camera) @ self.slope
        sh = torch.cat([moment.splats.sh[:, :1] + shine, moment.splats.sh[:, 1:]], dim=1)
        return replace(moment, splats=replace(moment.splats, sh=sh))

    def _direction(self, camera: Camera | None) -> Tensor:
        assert camera is not None, "a layer that needs a camera is always given one"
        return torch.nn.functional.normalize(torch.from_numpy(camera.centre).float(), dim=0)

    def penalty(self, moment: Moment, instant: Instant, generator: torch.Generator) -> Tensor:
        return 1e-3 * (self._direction(instant.camera) @ self.slope).square()


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> Glossy:
    return Glossy()


LAYER = "layers=[{name: test_glossy}]"


def test_it_trains_with_workers_without_and_resumed(tiny_scene: Path, tmp_path: Path) -> None:
    """A parameter may also be a single number."""
    trainer = assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, LAYER)
    tensors = trainer.model.tensors()
    assert tensors["layers.test_glossy.slope"].all() and tensors["layers.test_glossy.gain"]
    assert trainer.model.needs_camera


def test_whoever_needs_no_picture_has_a_camera_too(tiny_scene: Path) -> None:
    """The search for still splats and the warm-up."""
    trainer = trainer_of(tiny_scene, preset_of(*SETTLING, LAYER))
    warm_up_motion(trainer.scene, trainer.preset, best_engine("cpu"))
    for _ in range(STEPS):
        trainer.step()
    assert 0 < trainer.model.moving < len(trainer.model.splats)


@pytest.mark.parametrize("format_", ["ply", "ply-sequence"])
def test_what_depends_on_the_camera_is_not_exported(
    tiny_scene: Path, tmp_path: Path, format_: str
) -> None:
    trainer = trainer_of(tiny_scene, preset_of(LAYER))
    settings = Located({} if format_ == "ply" else {"frames": 2})
    out = tmp_path / "a.ply"
    with pytest.raises(UsageError, match="cannot carry splats that depend on the camera of this"):
        export(format_, trainer.model, trainer.facts, settings, out)
    assert not out.exists()
    with pytest.raises(ValueError, match="depends on the camera, and none is given"):
        trainer.model.instant(0.5)
