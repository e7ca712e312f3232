"""The trainer: that it learns, its phases, how it goes on after a stop, when it gives up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from kernel_checks import assert_same_on_threads
from motion_checks import are_among, splats_at
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

from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground import plugins
from gsdmsr_cli.ground.errors import GsdmsrError
from gsdmsr_cli.ground.measure import Measure
from gsdmsr_cli.model import motion as motions
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.runs import earlier
from gsdmsr_cli.training.gradients import compare
from gsdmsr_cli.training.population import density
from gsdmsr_cli.training.population.density import grow_and_prune
from gsdmsr_cli.training.starting import initial
from gsdmsr_cli.training.trainer import PATIENCE, Trainer

every_motion = pytest.mark.parametrize("motion", plugins.names(motions.__name__))

SPLATS = ("means", "quats", "log_scales", "logit_opacities", "sh")


class RecordingEngine:
    """An engine that remembers what it was asked to draw."""

    def __init__(self) -> None:
        self.splats: list[Splats] = []
        self.sizes: list[tuple[int, int]] = []
        self.degrees: list[int] = []

    def unavailable(self, device: str) -> str | None:
        return None

    def rasterize(self, moment: Moment, camera: Any, background: Any, *rest: Any) -> Frame:
        self.splats.append(moment.splats.map(lambda t: t.detach().clone()))
        self.sizes.append((camera.width, camera.height))
        self.degrees.append(rest[0])
        return best_engine("cpu").rasterize(moment, camera, background, *rest)


def after(trainer: Trainer, steps: int) -> list[float]:
    """Make steps and return their losses."""
    return [trainer.step().loss for _ in range(steps)]


def state_of(trainer: Trainer) -> dict[str, Tensor]:
    return copies(trainer.checkpoint().tensors)


@every_motion
def test_training_lowers_the_loss(tiny_scene: Path, motion: str) -> None:
    options = ["training.steps=80", "splats.count=300", "density.reset_at=[]", "density.cap=400"]
    options += ["losses.quadratic=0"]  # one loss all the time
    losses = after(trainer_of(tiny_scene, preset_of(*options, motion=motion)), 80)
    assert sum(losses[-12:]) < 0.6 * sum(losses[:12])


@pytest.fixture(scope="module")
def uninterrupted(tiny_scene: Path) -> dict[str, tuple[list[float], dict[str, Tensor]]]:
    """Losses and end of a whole training, by motion."""
    found = {}
    for motion in plugins.names(motions.__name__):
        trainer = trainer_of(tiny_scene, preset_of(motion=motion))
        found[motion] = after(trainer, STEPS), state_of(trainer)
    return found


# before anything has moved, while growing, right before and after the reset at 0.4, and while all
# that still happens is pruning
@every_motion
@pytest.mark.parametrize("stop", [1, 7, 16, 17, 35])
def test_a_resumed_training_goes_on_as_if_never_interrupted(
    tiny_scene: Path, tmp_path: Path, uninterrupted: Any, motion: str, stop: int
) -> None:
    losses, end = uninterrupted[motion]
    first = trainer_of(tiny_scene, preset_of(motion=motion))
    assert after(first, stop) == losses[:stop]
    run = run_of(first, tmp_path / "run")
    run.save(first.checkpoint())
    after(first, 3)  # what happens after a checkpoint does not count

    second = trainer_of(tiny_scene, preset_of(motion=motion))
    after(second, 2)  # nor what a trainer did before
    second.restore(run.load())
    assert second.clock.step == stop and second.clock.progress == stop / STEPS
    assert after(second, STEPS - stop) == losses[stop:]
    assert_same_tensors(state_of(second), end)


def test_a_checkpoint_of_the_version_before_is_gone_on_with(
    tiny_scene: Path, uninterrupted: Any
) -> None:
    """It counted rounds of growth, resets and thinnings in the state itself; the first had none."""
    losses, end = uninterrupted["multiscale"]
    first, second = (trainer_of(tiny_scene, preset_of()) for _ in range(2))
    after(first, 17)
    made = first.checkpoint()
    state = {key: value for key, value in made.state.items() if key not in ("events", "dropped")}
    events = made.state["events"]
    state["rounds"], state["resets"] = events["density"]["rounds"], events["opacity_reset"]["count"]
    assert state["rounds"] > 0 and state["resets"] == 1
    state = earlier.present_state(state, "multiscale")
    second.restore(replace(made, state=state, tensors=copies(made.tensors)))
    assert after(second, STEPS - 17) == losses[17:]
    assert_same_tensors(state_of(second), end)


def test_the_training_that_is_resumed_has_grown_and_moved(uninterrupted: Any) -> None:
    """So that the test above compares something."""
    for motion, (losses, end) in uninterrupted.items():
        assert len(set(losses)) == STEPS
        assert len(end["splats.means"]) == 200 == len(end["density.total"])
        assert len(end["adam.second.splats.sh"]) == 200
        assert (motion == "static") == (not any(name.startswith("motion.") for name in end))


def test_wall_time_goes_on_too(tiny_scene: Path) -> None:
    preset = preset_of("training.budget=100s")
    first, second = trainer_of(tiny_scene, preset), trainer_of(tiny_scene, preset)
    first.clock.before = 40.0
    second.restore(first.checkpoint())
    assert second.clock.elapsed == 40.0 and second.clock.progress == pytest.approx(0.4)


def test_the_seed_decides(tiny_scene: Path, uninterrupted: Any) -> None:
    other = trainer_of(tiny_scene, preset_of("training.seed=1"))
    assert after(other, 3) != uninterrupted["multiscale"][0][:3]


@every_motion
def test_training_does_not_depend_on_the_number_of_threads(tiny_scene: Path, motion: str) -> None:
    def train() -> Sequence[Tensor]:
        trainer = trainer_of(
            tiny_scene, preset_of("losses.ssim=0.2", "losses.ssim_until=0.5", motion=motion)
        )
        after(trainer, STEPS)
        return list(state_of(trainer).values())

    assert_same_on_threads(train)


@pytest.mark.parametrize("motion", ["hexplane", "multiscale"])
def test_nothing_moves_in_the_static_phase(tiny_scene: Path, motion: str) -> None:
    engine = RecordingEngine()
    options = ["training.static_until=0.25", "density.start=999"]
    trainer = trainer_of(tiny_scene, preset_of(*options, motion=motion), engine)
    start = copies(trainer.model.tensors())
    for _ in range(STEPS // 4):
        still = trainer.model.splats.means.detach().clone()
        trainer.step()
        assert torch.equal(engine.splats[-1].means, still)
    for name, tensor in trainer.model.tensors().items():
        assert torch.equal(tensor, start[name]) == name.startswith(("motion.", "layers.")), name
    after(trainer, 4)
    changed = [
        name
        for name, tensor in trainer.model.tensors().items()
        if name.startswith("motion.") and not torch.equal(tensor, start[name])
    ]
    assert changed
    moved = [splats_at(trainer.model, time).means for time in (0.0, 0.5)]
    assert not torch.equal(*moved)


@pytest.mark.parametrize(("steps", "first"), [(3, 3), (300, 10), (0, 0)])
def test_the_static_phase_ends_by_progress_or_by_steps(
    tiny_scene: Path, steps: int, first: int
) -> None:
    options = ["training.static_until=0.25", f"training.static_steps={steps}"]
    trainer, moving = trainer_of(tiny_scene, preset_of(*options)), []
    for _ in range(12):
        trainer.step()
        moving.append(trainer.checkpoint().state["moving"])
    assert moving.index(True) == first


def test_the_motion_starts_without_the_momentum_of_the_static_phase(tiny_scene: Path) -> None:
    options = ["training.static_until=0.25", "density.start=999"]
    trainer = trainer_of(tiny_scene, preset_of(*options))
    after(trainer, STEPS // 4)
    assert trainer.optimizer.first["splats.means"].any()
    reset: list[tuple[str, bool]] = []
    reset_moments = trainer.optimizer.reset_moments

    def remember(name: str, second: bool = True) -> None:
        reset.append((name, second))
        reset_moments(name, second)

    trainer.optimizer.reset_moments = remember  # type: ignore[method-assign]
    after(trainer, 3)
    # the second moments, which say how large a step may be, stay
    assert reset == [(f"splats.{name}", False) for name in SPLATS]


def test_a_motion_is_anchored_anew_as_it_begins_and_after_every_growth(tiny_scene: Path) -> None:
    options = ["training.static_until=0.25", "density.gradient=1e-9", "density.reset_at=[]"]
    options += ["density.cap=1000"]  # there is room to grow after it has begun
    trainer = trainer_of(tiny_scene, preset_of(*options, motion="control_points"))
    anchored: list[tuple[int, int]] = []
    reanchor = trainer.model.reanchor

    def remember() -> list[str]:
        names = reanchor()
        points = trainer.model.tensors()["motion.control_points"]
        means = trainer.model.splats.means
        assert are_among(points, means)
        anchored.append((trainer.clock.step, len(means)))
        return names

    trainer.model.reanchor = remember  # type: ignore[method-assign]
    counts = []
    for step in range(STEPS):
        counts.append(len(trainer.model.splats))
        trainer.step()
        if (step + 1, len(trainer.model.splats)) in anchored:
            for moments in (trainer.optimizer.first, trainer.optimizer.second):
                assert not moments["motion.control_points"].any()
    grown = [(step, n) for step, (o, n) in enumerate(pairwise(counts), start=1) if n > o]
    first = STEPS // 4
    assert anchored[0] == (first, counts[first])
    assert len(anchored) > 1 and anchored[1:] == [(step, n) for step, n in grown if step > first]


@pytest.mark.parametrize(("steps", "every"), [(40, 1), (40, 2), (120, 2), (40, 5)])
def test_a_longer_training_grows_no_more_often(
    tiny_scene: Path, monkeypatch: pytest.MonkeyPatch, steps: int, every: int
) -> None:
    """Six times up to half of the progress, or every fifth of 20 steps."""
    grown: list[int] = []

    def remember(*arguments: Any) -> Any:
        if arguments[4]:
            grown.append(trainer.clock.step)
        return grow_and_prune(*arguments)

    monkeypatch.setattr(density, "grow_and_prune", remember)
    options = (f"training.steps={steps}", f"density.every={every}", "density.start=0")
    preset = preset_of(*options, "density.rounds=6", "density.until=0.5", "density.reset_at=[]")
    trainer = trainer_of(tiny_scene, preset)
    after(trainer, steps)
    assert len(grown) == min(6, steps // 2 // every)
    assert all(step % every == 0 for step in grown) and grown[-1] > steps / 3


def test_in_a_long_training_more_splats_grow(tiny_scene: Path) -> None:
    steps = "training.steps=60", "density.every=10", "density.start=0", "density.reset_at=[]"
    grown = []
    for long_from in (0, 6, 1):
        preset = preset_of(
            *steps, f"density.long_from={long_from}", "density.cap=9000", "density.gradient=1e-2"
        )
        trainer = trainer_of(tiny_scene, preset)
        after(trainer, 60)
        grown.append(len(trainer.model.splats))
    assert grown[0] < grown[1] < grown[2]


def test_the_motion_is_told_where_the_first_splats_are(tiny_scene: Path) -> None:
    trainer = trainer_of(tiny_scene, preset_of("splats.count=2000", "density.cap=2000"))
    lower, upper = torch.tensor(trainer.facts.box)
    means = trainer.model.splats.means.detach()
    outside = ((means < lower) | (means > upper)).float().mean(dim=0)
    assert (outside < 0.02).all()  # the start is a cube of 2.6, whose strays are few
    assert ((upper - lower) < 1.15 * 2.6).all()
    # strays do not stretch the box
    strays = torch.cat([means, torch.full((10, 3), 1e3)])
    assert torch.tensor(initial._box(strays, 1.3)).abs().max() < 1.5
    assert torch.tensor(initial._box(means[:1], 1.3)).diff(dim=0).min() > 0.02


def test_every_view_is_seen_before_any_again(tiny_scene: Path) -> None:
    preset = preset_of("training.low_resolution_until=0")
    trainer, seen = trainer_of(tiny_scene, preset), []
    load = trainer.renderer.pictures.load

    def remember(view: Any) -> Tensor:
        seen.append(view.name)
        return load(view)

    trainer.renderer.pictures.load = remember  # type: ignore[method-assign]
    after(trainer, 36)
    rounds = [seen[i : i + 12] for i in (0, 12, 24)]
    for names in rounds:
        assert len(set(names)) == 12
    assert rounds[0] != rounds[1]


def test_splats_that_hardly_move_are_let_stand_still(tiny_scene: Path) -> None:
    trainer = trainer_of(tiny_scene, preset_of(*SETTLING))
    shares = []
    for _ in range(STEPS):
        trainer.step()
        shares.append(1 - trainer.model.moving / len(trainer.model.splats))
    assert shares[: STEPS // 2] == [0.0] * (STEPS // 2)
    assert 0 < shares[-1] < 1 and shares == sorted(shares)
    # after step 35, which begins at 0.85, averaging is near and nothing changes any more
    assert shares[35:] == [shares[35]] * 5
    moving = trainer.model.moving
    assert len(trainer.optimizer.first["motion.embeddings"]) == moving
    assert len(trainer.optimizer.first["splats.means"]) == len(trainer.model.splats)
    first, last = splats_at(trainer.model, 0.0).means, splats_at(trainer.model, 1.0).means
    still = torch.arange(len(first)) >= moving
    assert torch.equal((first == last).all(dim=1), still)


def test_nothing_stands_still_unless_asked_for(tiny_scene: Path) -> None:
    trainer = trainer_of(tiny_scene, preset_of())
    after(trainer, STEPS)
    assert trainer.model.moving == len(trainer.model.splats)
    assert not any("moving" in name for name in trainer.checkpoint().tensors)


def test_a_training_with_still_splats_is_resumed_as_if_never_interrupted(
    tiny_scene: Path, tmp_path: Path
) -> None:
    whole = trainer_of(tiny_scene, preset_of(*SETTLING))
    losses = after(whole, STEPS)
    for stop in (26, 37):  # before and while values are averaged
        first, second = (trainer_of(tiny_scene, preset_of(*SETTLING)) for _ in range(2))
        after(first, stop)
        run = run_of(first, tmp_path / str(stop))
        run.save(first.checkpoint())
        second.restore(run.load())
        assert 0 < second.model.moving < len(second.model.splats)
        assert after(second, STEPS - stop) == losses[stop:]
        assert_same_tensors(state_of(second), state_of(whole))
        model, _ = run.load_model()
        assert model.moving == first.model.moving
        assert torch.equal(splats_at(model, 0.3).means, splats_at(first.result(), 0.3).means)


def test_a_training_with_still_splats_can_be_lengthened(tiny_scene: Path, tmp_path: Path) -> None:
    """Progress goes back to where splats grow; clones and children stand still as parents do."""
    first = trainer_of(tiny_scene, preset_of(*SETTLING))
    after(first, STEPS)
    still = len(first.model.splats) - first.model.moving
    assert still > 0
    run = run_of(first, tmp_path / "run")
    run.save(first.checkpoint())
    longer = f"training.steps={4 * STEPS}", "density.gradient=1e-12", "density.cap=1000"
    second = trainer_of(tiny_scene, preset_of(*SETTLING, *longer))
    second.restore(run.load())
    after(second, STEPS // 2)
    model = second.model
    assert len(model.splats) - model.moving > still
    assert len(second.optimizer.first["motion.embeddings"]) == model.moving
    at_ends = [splats_at(model, time).means for time in (0.0, 1.0)]
    still_rows = torch.arange(len(model.splats)) >= model.moving
    assert torch.equal((at_ends[0] == at_ends[1]).all(dim=1), still_rows)


def test_several_views_a_step_are_averaged(tiny_scene: Path) -> None:
    engine = RecordingEngine()
    trainer = trainer_of(tiny_scene, preset_of("training.views_per_step=3"), engine)
    after(trainer, 2)
    assert len(engine.splats) == 6 and trainer.clock.step == 2
    assert trainer.optimizer.steps["splats.means"] == 2


def test_pictures_are_small_at_first_where_asked_for(tiny_scene: Path) -> None:
    engine = RecordingEngine()
    preset = preset_of("training.low_resolution_until=0.5", "data.downscale=2")
    after(trainer_of(tiny_scene, preset, engine), STEPS)
    assert engine.sizes == [(12, 12)] * (STEPS // 2) + [(24, 24)] * (STEPS // 2)


def test_ssim_counts_up_to_its_end_and_squares_from_their_beginning(
    tiny_scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measures, true = [], compare.photometric_loss

    def remember(rgb: Tensor, target: Tensor, measure: Measure) -> Tensor:
        measures.append(measure)
        return true(rgb, target, measure)

    monkeypatch.setattr(compare, "photometric_loss", remember)
    options = "losses={ssim: 0.4, ssim_until: 0.25, quadratic: 0.1, quadratic_from: 0.5}"
    after(trainer_of(tiny_scene, preset_of(options), RecordingEngine()), STEPS)
    quarter = STEPS // 4
    then, last = [Measure(0.0)] * quarter, [Measure(0.0, 0.1)] * (STEPS - 2 * quarter)
    assert measures == [Measure(0.4)] * quarter + then + last


def test_higher_degrees_of_colour_join_later(tiny_scene: Path) -> None:
    engine = RecordingEngine()
    preset = preset_of("splats.sh_degree=2", "splats.sh_start=0.25")
    after(trainer_of(tiny_scene, preset, engine), STEPS)
    assert engine.degrees == [0] * 10 + [1] * 10 + [2] * 20


def test_splats_grow_up_to_the_cap_and_opacities_are_reset(tiny_scene: Path) -> None:
    engine = RecordingEngine()
    options = ["density.reset_at=[0.5]", "density.reset_opacity=0.02", "density.until=0.4"]
    options += ["density.prune_opacity=0"]
    after(trainer_of(tiny_scene, preset_of(*options), engine), STEPS)
    counts = [len(splats) for splats in engine.splats]
    assert counts[:6] == [120] * 6 and counts[6] > 120  # drawn after six steps
    assert max(counts) == counts[-1] == 200
    opacity = [float(torch.sigmoid(splats.logit_opacities).max()) for splats in engine.splats]
    lowest = STEPS // 2 + 1  # drawn after the step that began at 0.5
    assert opacity[lowest - 1] > 0.1 and opacity[lowest] <= 0.02 + 1e-6
    assert opacity.count(opacity[lowest]) == 1


def test_a_training_without_splats_gives_up(tiny_scene: Path) -> None:
    trainer = trainer_of(tiny_scene, preset_of("density.prune_opacity=0.999"))
    with pytest.raises(GsdmsrError, match=r"no splats are left at step 6; if what moves"):
        after(trainer, STEPS)


class Losses:
    """Loss functions that are not finite when told so; a RecordingEngine asks them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.factor = 1.0
        self.true = compare.photometric_loss
        monkeypatch.setattr(compare, "photometric_loss", self)

    def __call__(self, *arguments: Any) -> Tensor:
        return self.true(*arguments) * self.factor


@pytest.fixture
def losses(monkeypatch: pytest.MonkeyPatch) -> Losses:
    return Losses(monkeypatch)


@pytest.mark.parametrize("factor", [math.nan, math.inf])
def test_a_step_without_a_finite_loss_changes_nothing(
    tiny_scene: Path, losses: Losses, factor: float
) -> None:
    trainer = trainer_of(tiny_scene, preset_of(), RecordingEngine())
    after(trainer, 8)
    before = state_of(trainer)
    del before["generator"]
    losses.factor = factor
    assert not math.isfinite(trainer.step().loss)
    assert trainer.clock.step == 9  # or a training of many such steps would have no end
    found = state_of(trainer)
    del found["generator"]
    assert_same_tensors(found, before)
    losses.factor = 1.0
    assert all(map(math.isfinite, after(trainer, 3)))
    assert all(tensor.isfinite().all() for tensor in trainer.model.tensors().values())


def test_training_gives_up_after_many_losses_in_a_row_that_are_not_finite(
    tiny_scene: Path, losses: Losses
) -> None:
    preset = preset_of("training.steps=1000", "density.start=999")
    trainer = trainer_of(tiny_scene, preset, RecordingEngine())
    losses.factor = math.nan
    after(trainer, PATIENCE - 1)
    losses.factor = 1.0
    after(trainer, 1)  # patience begins anew
    losses.factor = math.nan
    after(trainer, PATIENCE - 1)
    with pytest.raises(GsdmsrError, match=f"not finite for {PATIENCE} steps up to step 40"):
        trainer.step()
