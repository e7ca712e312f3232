"""A stream: what each moment sees and learns, and that it is the same however it is made."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch
from rigs import write_rig
from stream_checks import EACH, FIRST, MOMENTS, NEWCOMERS, WAYS, preset_of, stream_trainer, through
from training_checks import assert_same_tensors, copies, run_of

from gsdmsr_cli.backends.cpu import jit
from gsdmsr_cli.drawing.splatting import draw
from gsdmsr_cli.ground.measure import Measure
from gsdmsr_cli.ops.photometric import photometric_loss
from gsdmsr_cli.training.gradients.phase import Order, Phase
from gsdmsr_cli.training.losses import Seen
from gsdmsr_cli.training.losses.inverse_depth import InverseDepth
from gsdmsr_cli.training.streaming import trainer as module
from gsdmsr_cli.training.streaming.trainer import StreamTrainer


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_rig(tmp_path_factory.mktemp("rig"), moments=MOMENTS)


every_way = pytest.mark.parametrize("way", WAYS)

with_newcomers = pytest.mark.parametrize(
    ("way", "further"), [*((way, ()) for way in WAYS), *((way, (NEWCOMERS,)) for way in WAYS)]
)


@pytest.fixture
def trainer(rig: Path) -> StreamTrainer:
    return stream_trainer(rig)


def test_each_moment_sees_its_own_pictures_and_all_of_them_before_any_again(
    trainer: StreamTrainer, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[float, str]] = []
    order = StreamTrainer._order

    def remember(self: StreamTrainer, row: int, progress: float) -> Order:
        view = self.views[row]
        seen.append((view.time, view.name))
        return order(self, row, progress)

    monkeypatch.setattr(StreamTrainer, "_order", remember)
    through(trainer, MOMENTS)
    lengths = [FIRST, *[EACH] * (MOMENTS - 1)]
    for shot, length in zip(trainer.shots, lengths, strict=True):
        own, seen = seen[: 2 * length], seen[2 * length :]
        assert {time for time, _ in own} == {shot.time}
        assert len(shot.rows) == 6 == len({name for _, name in own[:6]})
    assert not seen


def test_terms_of_canonical_splats_count_at_the_first_moment_alone(
    rig: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[float] = []

    def value(self: InverseDepth, seen: Seen) -> torch.Tensor:
        asked.append(seen.instant.time)
        assert seen.frame is not None and seen.frame.depth is not None
        return seen.frame.depth.mean()

    monkeypatch.setattr(InverseDepth, "__call__", value)
    trainer = stream_trainer(rig, "losses.terms=[{name: inverse_depth}]")
    assert not trainer.frozen
    through(trainer, 2)
    assert trainer.frozen and asked == [trainer.shots[0].time] * 2 * FIRST


@pytest.mark.parametrize("weight", [0.0, 0.3])
def test_ssim_has_a_weight_of_its_own_after_the_first_moment(rig: Path, weight: float) -> None:
    options = "losses.ssim=0.5", "losses.ssim_until=1", "losses.terms=[]", f"stream.ssim={weight}"
    trainer = stream_trainer(rig, *options)

    def told() -> float:
        """Return the loss of the first view of the moment, drawn in full."""
        phase = Phase(0.9, trainer.population.moving, frozen=trainer.frozen)
        own = trainer.renderer.gradients(trainer.model, [Order(trainer.shot.rows[0])], phase)
        return float(own[0].loss)

    def expected(of_ssim: float) -> float:
        view, pictures = trainer.views[trainer.shot.rows[0]], trainer.renderer.pictures
        with torch.no_grad():
            frame = draw(
                trainer.model, pictures.camera(view), view.time, trainer.renderer.engine,
                trainer.renderer.background, of_capture=True,
            )  # fmt: skip
            return float(photometric_loss(frame.rgb, pictures.load(view), Measure(of_ssim)))

    through(trainer, 1)
    assert told() == pytest.approx(expected(0.5), rel=1e-4)
    trainer.begin_next()
    trainer.step()
    assert told() == pytest.approx(expected(weight), rel=1e-4)
    assert expected(0.5) > 1.2 * expected(0.3) > 1.2 * expected(0.0)


@every_way
def test_after_the_first_moment_the_motion_alone_changes(rig: Path, way: str) -> None:
    trainer = stream_trainer(rig, way=way)
    through(trainer, 1)
    assert not trainer.motion.offsets.any() and len(trainer.model.splats) != 150
    before = copies(trainer.model.tensors())
    trainer.begin_next()
    through(trainer, 3)
    trainer.begin_next()
    trainer.step()
    staying = {f"motion.{name}" for name in trainer.motion.staying}
    for name, tensor in trainer.model.tensors().items():
        stays = not name.startswith("motion.") or name in staying
        assert torch.equal(tensor, before[name]) == stays, name
    assert set(trainer.optimizer.first) == trainer.learnt


@every_way
def test_the_loss_of_a_moment_falls(tmp_path: Path, way: str) -> None:
    free = [f"stream.{key}=0" for key in ("rigidity", "rotation_similarity", "isometry")]
    options = "training.steps=200", "stream.steps=60", "training.low_resolution_until=0", *free
    trainer = stream_trainer(write_rig(tmp_path, moments=2, span=0.1), *options, way=way)
    through(trainer, 1)
    trainer.begin_next()
    losses = [float(trainer.step().loss) for _ in range(60)]
    assert sum(losses[-12:]) < sum(losses[:12])


def test_the_result_of_a_moment_is_the_mean_of_its_last_steps(trainer: StreamTrainer) -> None:
    through(trainer, 1)
    trainer.begin_next()
    while trainer.clock.progress < 1:
        trainer.step()
    average = copies(trainer.population.average.tensors)
    trainer.settle()
    assert torch.equal(trainer.motion.offsets, average["motion.offsets"])
    settled = copies(trainer.model.tensors())
    trainer.settle()
    assert_same_tensors(copies(trainer.model.tensors()), settled)


def test_a_place_that_is_not_finite_goes_back_to_the_last_moment(trainer: StreamTrainer) -> None:
    """Splats are never dropped: every moment's file has the same ones."""
    through(trainer, 2)
    trainer.begin_next()
    trainer.step()
    count = len(trainer.model.splats)
    with torch.no_grad():
        trainer.motion.offsets[3, 1] = torch.nan
        trainer.motion.turns[5, 2] = torch.inf
    past = trainer.motion.past_offsets[3, 0].clone(), trainer.motion.past_turns[5, 0].clone()
    trainer._mend()
    assert torch.equal(trainer.motion.offsets[3], past[0])
    assert torch.equal(trainer.motion.turns[5], past[1])
    while trainer.clock.progress < 1:
        trainer.step()
    assert len(trainer.model.splats) == count
    assert all(t.isfinite().all() for t in trainer.model.tensors().values())


def test_a_grid_that_is_not_finite_goes_on_from_nothing(rig: Path) -> None:
    trainer = stream_trainer(rig, way="3dgstream")
    through(trainer, 2)
    trainer.begin_next()
    trainer.step()
    with torch.no_grad():
        trainer.motion.tensors()["table"][3, 1] = torch.nan
    trainer._mend()
    assert trainer.motion.tensors()["table"][3, 1] == 0
    assert trainer.optimizer.first["motion.table"][3, 1] == 0
    through(trainer, MOMENTS)
    assert all(t.isfinite().all() for t in trainer.model.tensors().values())


@every_way
def test_what_is_drawn_stays_as_a_moment_ends(rig: Path, way: str) -> None:
    trainer = stream_trainer(rig, "training.average_from=1", way=way)
    through(trainer, 2)
    trainer.begin_next()
    while trainer.clock.progress < 1:
        trainer.step()
    seen = []
    for _ in range(2):
        seen.append(trainer.model.at(trainer.model.instant(trainer.shot.time)).splats)
        trainer.settle()
    assert not torch.equal(seen[0].means, trainer.model.splats.means)
    torch.testing.assert_close(seen[1].means, seen[0].means, rtol=0, atol=1e-6)
    torch.testing.assert_close(seen[1].quats, seen[0].quats, rtol=0, atol=1e-5)


@with_newcomers
def test_workers_change_nothing(rig: Path, way: str, further: tuple[str, ...]) -> None:
    if not (sys.platform.startswith("linux") and jit.set_threads(2) == 2 and jit.may_fork()):
        pytest.skip("processes cannot be forked here, or there is one core")
    with stream_trainer(rig, *further, way=way) as helped:
        helped.start_workers(lambda: None)
        assert len(helped.workers) == 2
        through(helped, MOMENTS)
        found = copies(helped.checkpoint().tensors)
    jit.set_threads(0)
    alone = stream_trainer(rig, *further, way=way)
    through(alone, MOMENTS)
    assert_same_tensors(found, copies(alone.checkpoint().tensors))


@with_newcomers
@pytest.mark.parametrize("steps", [FIRST // 2, FIRST, FIRST + 2, FIRST + 3, FIRST + EACH + 5])
def test_a_stream_that_is_resumed_ends_as_one_that_was_not(
    rig: Path, tmp_path: Path, steps: int, way: str, further: tuple[str, ...]
) -> None:
    whole, first, second = (stream_trainer(rig, *further, way=way) for _ in range(3))
    through(whole, MOMENTS)
    while first.clock.step < steps:
        if first.clock.progress >= 1:
            first.settle()
            first.begin_next()
        first.step()
    run = run_of(first, tmp_path / "run")
    run.save(first.checkpoint())
    second.restore(run.load())
    assert second.clock.moment == first.clock.moment
    assert second.clock.overall == first.clock.overall
    through(second, MOMENTS)
    assert_same_tensors(copies(second.checkpoint().tensors), copies(whole.checkpoint().tensors))


def test_progress_is_that_of_the_moment_and_of_all(trainer: StreamTrainer) -> None:
    """Of all it is a share of the steps: the first moment has as many as three later ones."""
    clock, first = trainer.clock, FIRST / (FIRST + EACH * (MOMENTS - 1))
    for _ in range(FIRST // 2):
        trainer.step()
    assert (clock.progress, clock.overall) == (0.5, 0.5 * first)
    through(trainer, 1)
    trainer.begin_next()
    assert (clock.progress, clock.overall, clock.step) == (0.0, first, FIRST)
    through(trainer, MOMENTS)
    assert (clock.progress, clock.overall) == (1.0, 1.0)
    assert trainer.checkpoint().progress == 1.0


def test_a_moment_may_be_given_a_time(rig: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = stream_trainer(rig, "training.budget=60s", "stream.budget=10s")
    clock = trainer.clock
    now = [100.0]
    monkeypatch.setattr(module.StreamClock, "elapsed", property(lambda self: now[0] - 100.0))
    now[0] += 30
    assert clock.progress == 0.5
    assert clock.overall == pytest.approx(30 / (60 + 10 * (MOMENTS - 1)))
    now[0] += 31
    assert clock.progress == 1.0
    clock.begin(1, preset_of("training.budget=60s", "stream.budget=10s"))
    now[0] += 4
    assert clock.progress == pytest.approx(0.4)
    assert clock.spent == pytest.approx(4)


def test_a_moment_takes_its_time_with_all_that_follows_its_steps(
    rig: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = "training.budget=60s", "stream.budget=10s"
    clock, preset = stream_trainer(rig, *options).clock, preset_of(*options)
    now = [0.0]
    monkeypatch.setattr(module.StreamClock, "elapsed", property(lambda self: now[0]))
    now[0] = 63.0  # of which 3 s went into settling and writing: the first is another matter
    clock.begin(1, preset)
    now[0] += 10.0
    assert clock.progress == 1
    now[0] += 1.0
    for moment in (2, 3):  # each has 9 s for its steps, and is over after 10
        clock.begin(moment, preset)
        now[0] += 4.5
        assert clock.progress == pytest.approx(0.5)
        now[0] += 5.5
    now[0] += 90.0
    clock.begin(4, preset)  # half of the time is the least that steps are given
    now[0] += 2.5
    assert clock.progress == pytest.approx(0.5)
    again = module.StreamClock(1, None, moments=MOMENTS)
    again.restore(clock.state())
    again.measure(preset)
    assert again.progress == pytest.approx(0.5)
