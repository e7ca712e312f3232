"""Steps that are recorded and replayed: nothing but the views differs, and all of these do.

Without a card a recording is played by doing the work of the first time once more, with its views,
cameras and times, while every structure that was said to differ is filled anew. What does not go
through one of these stays what it was, so that gradients are those of other views.
"""

from __future__ import annotations

import ctypes
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from training_checks import preset_of, trainer_of

from gsdmsr_cli.backends.cuda import graphs, recording
from gsdmsr_cli.ground.errors import GsdmsrError
from gsdmsr_cli.raster import load_engine
from gsdmsr_cli.training.gradients import replays
from gsdmsr_cli.training.gradients.phase import Order, Phase, ViewGradients
from gsdmsr_cli.training.gradients.replays import Replays, ViewInputs, recorder_for
from gsdmsr_cli.training.trainer import Trainer

MOTIONS = [
    ("control_points", ("motion.count=20",)),
    ("control_points", ("motion.count=20", "motion.time_offsets_from=0")),
    ("control_points", ("motion.count=20", "layers=[{name: lighting}]")),
    ("control_points", ("motion.count=20", "layers=[{name: shading, since: 0}]")),
    ("hexplane", ()),
    ("multiscale", ()),
    ("static", ()),
]
VIEWS = 3


class Refilled:
    """Plays a recording: fills whatever differs as soon as it is there."""

    def __init__(self, inputs: ViewInputs) -> None:
        self.inputs, self.launches, self.filled = inputs, 0, 0

    def listens(self) -> bool:
        return True

    def vary(self, structure: ctypes.Structure, fill: recording.Fill) -> None:
        self.filled += 1
        fill(structure, self.inputs)

    def keep(self, tensor: torch.Tensor) -> None: ...

    def follow(self, what: recording.Followed) -> None:
        assert what.is_good()

    def launched(self, launched: recording.Launched) -> None:
        self.launches += 1


class Played:
    """A recording, and the recorder that makes it."""

    def __init__(self) -> None:
        self.recorded = self.played = 0
        self.good = True

    def record(self, work: Callable[[], Any], inputs: ViewInputs) -> Played:
        self.work, self.good = work, True
        self.recorded += 1
        return self

    def is_good(self) -> bool:
        return self.good

    def replay(self, inputs: ViewInputs) -> Any:
        self.played += 1
        self.last = Refilled(inputs)
        with recording.recorded_by(self.last):
            return self.work()


def trainer_that_records(scene: Path, motion: str, *options: str) -> tuple[Trainer, Played]:
    """Return a trainer whose motion says something, and who records its steps."""
    preset = preset_of(
        "training.low_resolution_until=0", "training.static_until=0", "density.start=1000",
        f"training.views_per_step={VIEWS}", "losses.terms=[]", "layers=[]", "motion.coarse_until=0"
        if motion == "multiscale" else "density.start=1000", *options, motion=motion,
    )  # fmt: skip
    trainer = trainer_of(scene, preset, load_engine("cuda"))
    for _ in range(4):
        trainer.step()
    played = Played()
    trainer.renderer._replays = Replays(played)
    return trainer, played


def orders(*rows: int) -> list[Order]:
    return [Order(row) for row in rows]


def assert_same(found: list[ViewGradients], expected: list[ViewGradients]) -> None:
    assert len(found) == len(expected)
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(ours.loss, theirs.loss)
        torch.testing.assert_close(ours.on_screen, theirs.on_screen)
        for one, other in zip(ours.gradients, theirs.gradients, strict=True):
            assert (one is None) == (other is None)
            if one is not None:
                torch.testing.assert_close(one, other)


@pytest.mark.usefixtures("kernels_on_the_cpu")
class TestReplayed:
    @pytest.mark.parametrize(("motion", "options"), MOTIONS)
    @pytest.mark.parametrize("ssim", [0.0, 0.2])
    def test_other_views_have_their_own_gradients(
        self, tiny_scene: Path, motion: str, options: tuple[str, ...], ssim: float
    ) -> None:
        trainer, played = trainer_that_records(
            tiny_scene, motion, *options, f"losses.ssim={ssim}", "losses.ssim_until=1"
        )
        renderer, model, phase = trainer.renderer, trainer.model, Phase(0.5, True)
        for rows in ((0, 1, 2), (0, 1, 2), (2, 3, 0), (1, 1, 3)):
            found = renderer.gradients(model, orders(*rows), phase)
        assert played.recorded == 1 and played.played == 3
        assert played.last.filled > 1 and played.last.launches > 5
        renderer._replays = Replays(None)
        assert_same(found, renderer.gradients(model, orders(1, 1, 3), phase))

    def test_a_mask_of_gradients_is_that_of_the_step(self, tiny_scene: Path) -> None:
        trainer, played = trainer_that_records(tiny_scene, "multiscale")
        renderer, model = trainer.renderer, trainer.model
        rows = torch.arange(len(model.splats))
        for by in (2, 2, 3):
            phase = Phase(0.5, True, rows % by == 0)
            found = renderer.gradients(model, orders(0, 1, 2), phase)
        assert played.played == 2
        renderer._replays = Replays(None)
        assert_same(found, renderer.gradients(model, orders(0, 1, 2), phase))

    def test_a_training_with_replays_loses_as_one_without(self, tiny_scene: Path) -> None:
        """Through growing, pruning, and the end of SSIM, with all recorded that can be."""
        options = (
            "training.steps=40", "splats.count=100", "density.start=4", "density.every=9",
            f"training.views_per_step={VIEWS}", "motion.count=20", "density.gradient=1e-6",
            "density.cap=200",
        )  # fmt: skip

        def train(played: Played | None) -> tuple[list[float], int]:
            preset = preset_of(*options, motion="control_points")
            trainer = trainer_of(tiny_scene, preset, load_engine("cuda"))
            trainer.renderer._replays = Replays(played)
            losses = [trainer.step().loss.item() for _ in range(40)]
            return losses, len(trainer.model.splats)

        played = Played()
        assert train(played) == train(None)
        assert played.recorded > 3 and played.played > 20

    @pytest.mark.parametrize(
        "option",
        ["losses.terms=[{name: temporal_smoothness}]", "layers=[{name: exposure}]",
         "training.views_per_step=1"],
    )  # fmt: skip
    def test_what_cannot_be_recorded_is_done(self, tiny_scene: Path, option: str) -> None:
        trainer, played = trainer_that_records(
            tiny_scene, "control_points", "motion.count=20", option
        )
        for _ in range(3):
            trainer.step()
        assert played.recorded == ("views_per_step" in option)


INPUTS = ViewInputs([], [], [])


def test_work_is_done_first_and_recorded_when_it_comes_again() -> None:
    played, done = Played(), []
    replays_ = Replays(played)

    def work() -> None:
        done.append(played.played)

    for known, recorded in (("a", 0), ("a", 1), ("a", 1), ("b", 1), ("a", 1), ("a", 2)):
        replays_.run(known, INPUTS, work)
        assert played.recorded == recorded
    assert len(done) == 6 and played.played == 3
    played.good = False
    replays_.run("a", INPUTS, work)
    assert played.recorded == 3


@pytest.mark.parametrize("error", [RuntimeError("not while capturing"), GsdmsrError("refused")])
def test_what_fails_to_be_recorded_is_done_and_in_the_end_with_a_warning(error: Exception) -> None:
    class Failing:
        def record(self, work: Callable[[], Any], inputs: ViewInputs) -> replays.Recording:
            raise error

    replays_ = Replays(Failing())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert [replays_.run("a", INPUTS, lambda i=i: i) for i in range(3)] == [0, 1, 2]
    assert replays_.able
    with pytest.warns(UserWarning, match=f"cannot be recorded as CUDA graphs: {error}"):
        assert replays_.run("a", INPUTS, lambda: 3) == 3
    assert not replays_.able
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert replays_.run("a", INPUTS, lambda: 4) == 4


def test_only_a_gpu_records(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(graphs, "can_record", lambda: True)
    monkeypatch.setattr(graphs, "GraphRecorder", lambda device: ("recorder", device))
    gpu = torch.device("cuda", 0)
    assert recorder_for(gpu, True) == ("recorder", gpu)
    assert recorder_for(gpu, False) is None
    assert recorder_for(torch.device("cpu"), True) is None
    monkeypatch.setattr(graphs, "can_record", lambda: False)
    assert recorder_for(gpu, True) is None
