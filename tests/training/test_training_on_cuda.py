"""Training by CUDA kernels: as on the CPU, on one device throughout, and without waiting for it.

The kernels run on the CPU (``kernels_on_the_cpu``), or nowhere: tensors on torch's device "meta"
have shapes but no values, refuse to meet those of other devices, and cannot be read. So whatever
would wait for a GPU in a step, or forget to move something to it, fails there.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from motion_checks import splats_at
from torch import Tensor
from training_checks import STEPS, preset_of, trainer_of

from gsdmsr_cli.backends.cuda import launch
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.model.motion import control_points
from gsdmsr_cli.model.motion._time_offsets import TimeOffsets
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.ops.rasterize.cuda import room
from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.raster import load_engine
from gsdmsr_cli.scene.pictures import Pictures, ResidentPictures
from gsdmsr_cli.training.gradients.phase import Order, Phase
from gsdmsr_cli.training.gradients.renderer import _alike
from gsdmsr_cli.training.trainer import Trainer

NEARLY = 2e-3
"""Losses after few steps: Adam's first steps have the size of the rate even for tiny gradients,
whose signs are those of rounding."""


@pytest.mark.usefixtures("kernels_on_the_cpu")
class TestOnTheCPU:
    @pytest.mark.parametrize("views", [1, 2])
    def test_losses_are_those_of_the_cpu_engine(self, tiny_scene: Path, views: int) -> None:
        preset = preset_of(f"training.views_per_step={views}", "training.static_until=0.03")
        found = losses(trainer_of(tiny_scene, preset, load_engine("cuda")), 5)
        kernels = launch.runners.pop("cpu")
        try:
            expected = losses(trainer_of(tiny_scene, preset), 5)
        finally:
            launch.runners["cpu"] = kernels
        assert found == pytest.approx(expected, rel=NEARLY)

    def test_half_precision_loses_as_float32_does(self, tiny_scene: Path) -> None:
        """Within what two engines in float32 may differ by, moving from the first step on."""
        options = (
            "training.static_until=0", "motion.coarse_until=0", "density.start=1000",
            "data.downscale=2",
        )  # fmt: skip

        def lose(precision: str) -> list[float]:
            preset = preset_of(*options, f"training.precision={precision}")
            return losses(trainer_of(tiny_scene, preset, load_engine("cuda")), 15)

        expected = lose("float32")
        for precision in ("bf16", "fp16"):
            found = lose(precision)
            assert found == pytest.approx(expected, rel=NEARLY)
            assert found != expected

    @pytest.mark.parametrize("precision", ["float32", "bf16"])
    def test_all_phases_of_a_training(self, tiny_scene: Path, precision: str) -> None:
        gate = "saliency.gate=scale", "saliency.gate_from=0.5"
        options = "data.downscale=2", "losses.quadratic=0", f"training.precision={precision}"
        preset = preset_of(*gate, *options)
        trainer = trainer_of(tiny_scene, preset, load_engine("cuda"))
        seen = losses(trainer, STEPS)
        assert all(map(math.isfinite, seen))
        assert sum(seen[-8:]) < sum(seen[:8])
        assert len(trainer.model.splats) != 120

    def test_two_views_at_once_are_two_views(self, tiny_scene: Path) -> None:
        preset = preset_of("data.downscale=2", "training.low_resolution_until=0")
        trainer = trainer_of(tiny_scene, preset, load_engine("cuda"))
        losses(trainer, 5)
        renderer, model = trainer.renderer, trainer.model
        phase, orders = Phase(0.9, True), [Order(0), Order(1)]
        together = renderer.gradients(model, orders, phase)
        alone = [renderer.gradients(model, [order], phase)[0] for order in orders]
        for one, other in zip(together, alone, strict=True):
            torch.testing.assert_close(one.loss, other.loss)
            torch.testing.assert_close(one.on_screen, other.on_screen, atol=1e-7, rtol=1e-3)
        for name, both, *parts in zip(
            model.trained(), together[0].gradients, *(view.gradients for view in alone), strict=True
        ):
            summed = sum(part for part in parts if part is not None)
            if both is not None:
                assert (both - summed).norm() <= 1e-4 * both.norm() + 1e-9, name
        assert not any(part is not None for part in together[1].gradients)


class Nobody:
    """Runs no kernel, but notes that it was asked to."""

    def __init__(self) -> None:
        self.asked: list[str] = []

    def launch(self, source, kernel, grid, block, arguments, device) -> None:
        self.asked.append(kernel)


SET_VALUES = Parameter.set_values


def swap_values(parameter: Parameter, values: Tensor) -> None:
    """Do what ``Parameter.set_values`` does, also from the CPU to "meta".

    Unlike that of a GPU, torch does not take memory of "meta" for a tensor of the CPU; it can only
    swap both tensors as a whole.
    """
    tensor, values = parameter.tensor, values.detach().contiguous()
    if tensor.device == values.device:
        SET_VALUES(parameter, values)
        return
    fresh = torch.nn.Parameter(values) if isinstance(tensor, torch.nn.Parameter) else values
    torch.utils.swap_tensors(tensor, fresh.requires_grad_(tensor.requires_grad))


@pytest.fixture
def nobody(monkeypatch: pytest.MonkeyPatch) -> Nobody:
    nobody = Nobody()
    monkeypatch.setitem(launch.runners, "meta", nobody)
    monkeypatch.setattr(Parameter, "set_values", swap_values)
    # the one thing that is waited for, once for each size of pictures
    monkeypatch.setattr(room.Room, "find", lambda *_: 1 << 14)
    return nobody


COLOURS = "layers=[{name: lighting}, {name: shading, since: 0}]"


def elsewhere(data: Path, preset: Preset) -> Trainer:
    pictures = Pictures((1.0, 1.0, 1.0), preset.data.downscale, 1 << 24)
    return Trainer(read_scene(data), preset, load_engine("cuda"), pictures, "meta")


@pytest.mark.parametrize(
    ("options", "kernel"),
    [
        (("training.static_until=1.0",), "ssim_maps"),
        ((), "space_penalty"),
        (("losses.ssim=0",), "blend_and_compare"),
        (("saliency.gate=scale", "saliency.gate_from=0"), "adam"),
        (("saliency.gate=freeze", "saliency.gate_from=0", "saliency.quantile=0.5"), "adam"),
        (("motion.smooth_weight=0.1",), "lookup_backward"),
        (("training.precision=bf16",), "collapse"),
        (("training.precision=fp16", "motion.smooth_weight=0.1"), "lookup_backward"),
    ],
)
@pytest.mark.parametrize("views", [1, 2])
def test_a_step_waits_for_nothing_and_stays_on_its_device(
    tiny_scene: Path, nobody: Nobody, views: int, options: tuple[str, ...], kernel: str
) -> None:
    preset = preset_of(
        "training.static_until=0", f"training.views_per_step={views}", "motion.coarse_until=0",
        "density.start=1000", "density.reset_at=[]", "training.average_from=0", "layers=[]",
        *options,
    )  # fmt: skip
    trainer = elsewhere(tiny_scene, preset)
    for _ in range(11):
        step = trainer.step()
    assert step.loss.device.type == "meta"
    assert {"project", "emit_short", "project_backward", "adam", kernel} <= set(nobody.asked)
    for tensor in trainer.model.tensors().values():
        assert tensor.device.type == "meta"
    nobody.asked.clear()
    trainer.step()  # the 12th, which has no regularisers
    assert len(nobody.asked) <= 14


@pytest.mark.parametrize("option", ["motion.heads=shared", "motion.heads=separate"])
def test_hexplane_stays_on_its_device(tiny_scene: Path, nobody: Nobody, option: str) -> None:
    trainer = elsewhere(tiny_scene, preset_of("training.static_until=0", option, motion="hexplane"))
    for _ in range(5):
        trainer.step()
    assert {"lookup", "lookup_backward", "time_penalty"} <= set(nobody.asked)


@pytest.mark.parametrize("further", [(), ("motion.time_offsets_from=0", COLOURS)])
def test_control_points_stay_on_their_device(
    tiny_scene: Path, nobody: Nobody, monkeypatch: pytest.MonkeyPatch, further: tuple[str, ...]
) -> None:
    """But for spreading them and reading offsets, which wait, as growing does."""
    monkeypatch.setattr(control_points.ControlPointMotion, "reanchor", lambda *_: ())
    monkeypatch.setattr(TimeOffsets, "advance", lambda *_: None)
    options = "training.static_until=0", "motion.count=20", "density.start=1000", *further
    trainer = elsewhere(tiny_scene, preset_of(*options, motion="control_points"))
    for _ in range(5):
        trainer.step()
    backward = {"transform_backward", "skin_backward", "lookup_backward"}
    assert {"nearest", "transform", "skin"} | backward <= set(nobody.asked)
    assert not further or {"hats", "add_series", "add_series_backward"} <= set(nobody.asked)


def test_offsets_of_frames_are_read_a_thousand_times(monkeypatch: pytest.MonkeyPatch) -> None:
    """A training on a GPU waits for it so often, and for a step's offsets never."""
    reads: list[float] = []
    monkeypatch.setattr(TimeOffsets, "_read", lambda _: reads.append(0.0))
    offsets = TimeOffsets(20)
    for step in range(20_001):
        offsets.advance(step / 20_000)
    assert 900 <= len(reads) <= 1001


def losses(trainer: Trainer, steps: int) -> list[float]:
    return [trainer.step().loss.item() for _ in range(steps)]


def test_pictures_are_copied_to_a_device_once(tiny_scene: Path) -> None:
    view, *others = read_scene(tiny_scene).split("train")
    pictures = Pictures((1.0, 1.0, 1.0), 1, 1 << 24)
    size = pictures.load(view).nbytes
    resident = ResidentPictures(torch.device("meta"), 2 * size)
    copy = resident.load(pictures, view)
    assert copy.device.type == "meta" and copy.shape == pictures.load(view).shape
    assert resident.load(pictures, view) is copy
    assert resident.load(pictures, others[0]) is resident.load(pictures, others[0])
    assert resident.load(pictures, others[1]) is not resident.load(pictures, others[1])


def test_pictures_on_the_cpu_are_passed_on(tiny_scene: Path) -> None:
    view = read_scene(tiny_scene).split("train")[0]
    pictures = Pictures((1.0, 1.0, 1.0), 1, 1 << 24)
    found = ResidentPictures(torch.device("cpu"), 0).load(pictures, view)
    assert torch.equal(found, pictures.load(view))


def test_pictures_of_two_sizes_are_two_pictures(tiny_scene: Path) -> None:
    view = read_scene(tiny_scene).split("train")[0]
    whole, halved = (Pictures((1.0, 1.0, 1.0), by, 1 << 24) for by in (1, 2))
    resident = ResidentPictures(torch.device("meta"), 1 << 24)
    assert resident.load(whole, view).shape == (3, 48, 48)
    assert resident.load(halved, view).shape == (3, 24, 24)


@pytest.mark.usefixtures("nobody")
def test_a_model_goes_to_another_device_with_its_names(tiny_scene: Path) -> None:
    model = trainer_of(tiny_scene, preset_of()).model
    before = model.tensors()
    shapes = {name: tensor.shape for name, tensor in before.items()}
    assert model.to("meta") is model
    assert {name: tensor.shape for name, tensor in model.tensors().items()} == shapes
    assert all(tensor is before[name] for name, tensor in model.tensors().items())
    for tensor in model.tensors().values():
        assert tensor.device.type == "meta" and tensor.requires_grad
    assert splats_at(model, 0.5).means.device.type == "meta"


def test_camera_sizes_decide_whether_views_go_together(tiny_scene: Path) -> None:
    first, second = (view.camera for view in read_scene(tiny_scene).split("train")[:2])
    weights = torch.ones(1)
    assert _alike([first, second], [None, None])
    assert _alike([first, second], [weights, weights])
    assert not _alike([first, replace(second, width=10)], [None, None])
    assert not _alike([first, second], [None, weights])


@pytest.mark.parametrize(
    ("option", "views"),
    [
        ("training.views_per_step=null", 8),
        ("training.views_per_step=5", 5),
        ("losses.terms=[{name: temporal_smoothness}]", 2),
        ("layers=[{name: exposure}]", 8),
        ("layers=[{name: decoder}]", 2),
        ("losses.inliers=0.9", 2),
    ],
)
def test_a_step_has_more_views_where_they_are_drawn_at_once(
    tiny_scene: Path, nobody: Nobody, option: str, views: int
) -> None:
    preset = preset_of("training.views_per_step=null", option)
    assert elsewhere(tiny_scene, preset).views_per_step == views
    assert trainer_of(tiny_scene, preset).views_per_step == (views if views == 5 else 2)
