"""Trainings that hold something of each view: cameras are found, results stay the same bits."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from motion_checks import disturbed
from torch import Tensor
from training_checks import (
    SETTLING,
    STEPS,
    assert_same_tensors,
    copies,
    preset_of,
    run_of,
    trainer_of,
)
from walking_capture import Capture, pixel_errors, write_capture

from gsdmsr_cli.backends.cpu import jit
from gsdmsr_cli.drawing.splatting import draw
from gsdmsr_cli.evaluation.protocol import ViewRenderer
from gsdmsr_cli.exports._asked import Asked
from gsdmsr_cli.exports._source import Source
from gsdmsr_cli.filming.buffers import BufferRenderer
from gsdmsr_cli.ground import plugins
from gsdmsr_cli.model import motion as motions
from gsdmsr_cli.model.layers.cameras import Cameras
from gsdmsr_cli.model.layers.exposure import Exposure
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.runs.packing import pack, unpack
from gsdmsr_cli.scene.film import Shot
from gsdmsr_cli.training.gradients.phase import Phase
from gsdmsr_cli.training.trainer import Trainer

CAMERAS = "{name: cameras, since: 0.2, rate: [1e-3, 1e-4]}"
EXPOSURE = "{name: exposure, rate: [1e-2, 1e-3]}"
LAYERS = {
    "cameras": f"[{CAMERAS}]",
    "exposure": f"[{EXPOSURE}]",
    "both": f"[{CAMERAS}, {EXPOSURE}]",
}

every_motion = pytest.mark.parametrize("motion", plugins.names(motions.__name__))
every_layer = pytest.mark.parametrize("layers", LAYERS)


def after(trainer: Trainer, steps: int) -> list[float]:
    """Make steps and return their losses."""
    return [float(trainer.step().loss) for _ in range(steps)]


def state_of(trainer: Trainer) -> dict[str, Tensor]:
    return copies(trainer.checkpoint().tensors)


@every_motion
def test_every_motion_is_trained_with_both_and_resumed(
    tiny_scene: Path, tmp_path: Path, motion: str
) -> None:
    preset = preset_of(f"layers={LAYERS['both']}", motion=motion)
    whole = trainer_of(tiny_scene, preset)
    losses = after(whole, STEPS)
    for name in ("cameras", "exposure"):
        values = whole.model.tensors()[f"layers.{name}.values"]
        assert (values != 0).any(dim=-1).all(), f"{name}: every view has been learnt from"
    first = trainer_of(tiny_scene, preset)
    assert after(first, 17) == losses[:17]
    run = run_of(first, tmp_path / "run")
    run.save(first.checkpoint())
    second = trainer_of(tiny_scene, preset)
    second.restore(run.load())
    assert after(second, STEPS - 17) == losses[17:]
    assert_same_tensors(state_of(second), state_of(whole))


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = jit.threads()
    if jit.set_threads(0) < 2 or not sys.platform.startswith("linux") or not jit.may_fork():
        jit.set_threads(before)
        pytest.skip("workers need two threads, Linux, and kernels that run in a forked process")
    jit.set_threads(2)
    yield
    jit.set_threads(before)


@every_layer
@pytest.mark.usefixtures("two_threads")
def test_workers_change_no_result(tiny_scene: Path, layers: str) -> None:
    """Also while some splats stand still."""
    options = (*SETTLING, "training.views_per_step=2", f"layers={LAYERS[layers]}")
    alone = trainer_of(tiny_scene, preset_of(*options))
    losses = after(alone, STEPS)
    with trainer_of(tiny_scene, preset_of(*options)) as assisted:
        assisted.start_workers(lambda: None)
        assert len(assisted.workers) == 2
        assert after(assisted, STEPS) == losses
    assert 0 < assisted.model.moving < len(assisted.model.splats)
    assert_same_tensors(state_of(assisted), state_of(alone))


def test_terms_of_the_loss_do_not_move_cameras(tiny_scene: Path) -> None:
    """What splats do in time says nothing of where a camera was."""
    given = f"layers=[{CAMERAS}]", "motion={name: polynomial}"
    smooth = "losses.terms=[{name: temporal_smoothness, factor: 100.0}]"
    found = []
    for options in (given, (*given, smooth)):
        trainer = trainer_of(tiny_scene, preset_of(*options))
        disturbed(trainer.model.layers["motion"])  # the term has a gradient by every splat
        trainer.model.advance(1.0)
        order, phase = trainer._choose_views(0.5), Phase(0.5, True)
        (view,) = trainer.renderer.gradients(trainer.model, order, phase)
        names = list(trainer.model.trained())
        found.append((view.loss, view.gradients[names.index("layers.cameras.values")]))
    (plain, expected), (more, own) = found
    assert more > 2 * plain and expected is not None and own is not None and expected.any()
    torch.testing.assert_close(own, expected, rtol=1e-3, atol=1e-7)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Capture]:
    folder = tmp_path_factory.mktemp("walk")
    return folder, write_capture(folder, size=64, frames=24, pixels=1.0, drift=0.2, seed=0)


@pytest.fixture(scope="module")
def refined(capture: tuple[Path, Capture]) -> Trainer:
    options = [
        "training.steps=500", "splats.count=1200", "density.cap=3000", "training.threads=1",
        # with the 3 of dnerf colours differ by direction as 24 pictures do by their exposures
        "splats.sh_degree=1", "splats.sh_start=0.3",
        f"layers=[{{name: cameras, rate: [3e-4, 3e-5]}}, {EXPOSURE}]",
    ]  # fmt: skip
    trainer = trainer_of(capture[0], load_preset("dnerf", None, options))
    after(trainer, 500)
    return trainer


def test_errors_of_poses_are_halved(refined: Trainer, capture: tuple[Path, Capture]) -> None:
    layer = refined.result().layers["layers.cameras"]
    assert isinstance(layer, Cameras)
    found = [layer.place(view.camera, view.time) for view in refined.views]
    before, now = (
        float(np.sqrt(np.square(pixel_errors(cameras, capture[1])).mean()))
        for cameras in (capture[1].given, found)
    )
    assert before == pytest.approx(1.0, abs=0.15)
    assert now < 0.5 * before


def test_exposures_are_found(refined: Trainer, capture: tuple[Path, Capture]) -> None:
    """The factors on a middle grey, in units of their mean."""
    layer = refined.result().layers["layers.exposure"]
    assert isinstance(layer, Exposure)
    values = (layer.values - layer.values.mean(dim=0)).detach().numpy()
    found = 1 + (values[:, :, :3] @ np.full(3, 0.4) + values[:, :, 3]) / 0.4
    true = capture[1].exposures
    off = found / found.mean(0) - true / true.mean(0)
    spread = true / true.mean(0) - 1
    assert np.sqrt(np.square(off).mean()) < 0.5 * np.sqrt(np.square(spread).mean())


def test_views_of_the_capture_are_drawn_by_what_was_learnt_and_others_are_not(
    refined: Trainer,
) -> None:
    training, model = refined.renderer, refined.result()
    given = training.engine, training.background
    renderer = ViewRenderer(model, training.engine, training.pictures, training.background)
    for split, expected in (("train", True), ("val", True), ("test", False)):
        view = refined.scene.split(split)[3]
        free = draw(model, training.pictures.camera(view), view.time, *given).rgb
        assert torch.equal(renderer.draw(view), free.detach()) != expected, split
        shot = Shot(training.pictures.camera(view), view.time, view)
        filmed = BufferRenderer(renderer, 1, ["rgb"]).draw(shot, None)
        assert np.array_equal(filmed.rgb, renderer.draw(view).numpy()), "a film shows the same"
    told = model.tell_views([(view.camera, view.time) for view in refined.scene.split("val")])
    assert set(told) == {"cameras", "exposure", "motion"}
    assert told["cameras"]["of_neighbours"] == len(refined.scene.split("val"))


def test_exports_lack_nothing_and_packed_runs_keep_what_is_known_of_views(
    refined: Trainer,
) -> None:
    model = refined.load(copies(refined.model.tensors()), 1.0)
    source = Source(model, Asked(), refined.facts)
    assert not source.lost_at(0.3) and not source.impossible_at(0.3)
    before = {name: t for name, t in copies(model.tensors()).items() if name.startswith("layers.")}
    packed, described = pack(model)
    found = unpack(packed, described, Path("run.compact"))
    assert len(before) == 8
    assert_same_tensors({name: found[name] for name in before}, before)
