"""Splats for what is new at a moment of a stream."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from rigs import VISITOR, write_rig
from stream_checks import (
    EACH,
    FIRST,
    MOMENTS,
    NEWCOMERS,
    preset_of,
    psnr_of,
    stream_trainer,
    through,
)

from gsdmsr_cli.gaussians.splats import NAMES
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.model.layers.exposure import Exposure
from gsdmsr_cli.model.layers.newcomers import BEGIN, FADED, OWN, Newcomers
from gsdmsr_cli.ops.spread import spacing
from gsdmsr_cli.training.streaming import trainer as streaming
from gsdmsr_cli.training.streaming.noticing import Places
from gsdmsr_cli.training.streaming.trainer import StreamTrainer
from gsdmsr_cli.training.trainer import check_plugins

COUNT = 30
"""Of newcomers, in ``NEWCOMERS``."""


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_rig(tmp_path_factory.mktemp("rig"), moments=MOMENTS)


def newcomers_of(trainer: StreamTrainer) -> Newcomers:
    assert trainer.newcomers is not None
    return trainer.newcomers


def test_they_have_the_exposure_of_a_camera_like_all_splats(rig: Path) -> None:
    trainer = stream_trainer(rig, NEWCOMERS)
    through(trainer, 2)
    layer, view = trainer.model.layers["layers.exposure"], trainer.views[trainer.shot.rows[0]]
    assert isinstance(layer, Exposure)
    with torch.no_grad():
        layer.values[0, :, 3] += 0.2  # of which the mean over six cameras is taken away
    instant, _ = trainer.model.instant_of_view(view.time, view.camera)
    plain = trainer.model.at(instant)
    seen = trainer.model.as_seen(plain, instant).splats.sh[:, 0] - plain.splats.sh[:, 0]
    assert trainer.model.moving == len(plain) and len(newcomers_of(trainer)) == COUNT
    torch.testing.assert_close(seen[-COUNT:], seen[:1].expand(COUNT, 3), rtol=0.2, atol=0.02)
    assert seen.min() > 0.15 / SH_C0 * 5 / 6


def test_what_comes_in_is_shown(tmp_path: Path) -> None:
    """A ball that stands in the scene from the second moment on; splats there were none before."""
    write_rig(tmp_path, size=48, cameras=8, moments=4, visitor=1)
    options = (
        "training.steps=200", "stream.steps=60", "splats.count=600", "density.cap=1000",
        "density.gradient=6e-4", "density.start=50", "density.every=30",
        "training.low_resolution_until=0",
    )  # fmt: skip
    found = []
    for further in ((), ("layers=[{name: exposure}, {name: newcomers, count: 300}]",)):
        trainer = stream_trainer(tmp_path, *options, *further)
        through(trainer, 4)
        found.append(psnr_of(trainer))
    without, with_newcomers = found
    assert with_newcomers > without + 1.5
    layer, centre = newcomers_of(trainer), torch.tensor(VISITOR[0])
    near = (layer.newest.means - centre).norm(dim=1) < 1.3 * VISITOR[1]
    assert near[~layer.faded()].float().mean() > 0.9
    assert (near & (layer.newest.logit_opacities > 0)).sum() > 40


def test_they_are_the_last_rows_that_move_and_nothing_else_changes(rig: Path) -> None:
    trainer, plain = stream_trainer(rig, NEWCOMERS), stream_trainer(rig)
    for one in (trainer, plain):
        through(one, 1)
    count = len(plain.model.splats)
    assert len(trainer.model.splats) == count + COUNT
    first = trainer.model.at(trainer.model.instant(trainer.shot.time)).splats
    before = plain.model.at(plain.model.instant(plain.shot.time)).splats
    for name, tensor in first.tensors().items():
        assert torch.equal(tensor[:count], before.tensors()[name])
    assert (first.logit_opacities[count:].sigmoid() < 1e-6).all()
    through_next(trainer)
    drawn = trainer.model.at(trainer.model.instant(trainer.shot.time)).splats
    for name, tensor in newcomers_of(trainer).newest.tensors().items():
        assert torch.equal(drawn.tensors()[name][-COUNT:], tensor)
    assert (drawn.logit_opacities[-COUNT:].sigmoid() > FADED).any()


def through_next(trainer: StreamTrainer) -> None:
    trainer.begin_next()
    while trainer.clock.progress < 1:
        trainer.step()
    trainer.settle()


def test_those_of_a_moment_are_there_until_the_next(rig: Path) -> None:
    trainer = stream_trainer(rig, NEWCOMERS)
    through(trainer, 3)
    layer = newcomers_of(trainer)
    last = {name: tensor[:, 0].clone() for name, tensor in layer.past.items()}
    now = {name: tensor.clone() for name, tensor in layer.newest.tensors().items()}
    assert not torch.equal(last["means"], now["means"])
    times = [shot.time for shot in trainer.shots]
    middle = (times[1] + times[2]) / 2
    for time, expected in ((times[1], last), (middle, last), (times[2], now), (1.0, now)):
        drawn = trainer.model.at(trainer.model.instant(time)).splats
        for name in NAMES:
            assert torch.equal(drawn.tensors()[name][-COUNT:], expected[name]), (time, name)
    hidden = trainer.model.at(trainer.model.instant(times[1] / 2)).splats.logit_opacities[-COUNT:]
    assert (hidden.sigmoid() < 1e-6).all()


def test_they_go_on_at_the_next_moment_and_are_looked_for_once(
    rig: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer = stream_trainer(rig, NEWCOMERS)
    through(trainer, 2)
    before = newcomers_of(trainer).newest.means.clone()
    trainer.begin_next()
    assert torch.equal(newcomers_of(trainer).newest.means, before)
    looked: list[float] = []
    find = streaming.find_places

    def counted(*given: Any) -> Places:
        looked.append(trainer.clock.progress)
        return find(*given)

    monkeypatch.setattr(streaming, "find_places", counted)
    while trainer.clock.progress < 1:
        trainer.step()
    assert len(looked) == 1 and 0.3 <= looked[0] < 0.3 + 2 / EACH
    assert not torch.equal(newcomers_of(trainer).newest.means, before)


def test_only_those_that_have_faded_are_placed_anew(
    rig: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer = stream_trainer(rig, NEWCOMERS)
    through(trainer, 1)
    trainer.begin_next()
    layer = newcomers_of(trainer)
    layer.newest.logit_opacities.data[:10] = 2.0
    there = layer.newest.means.detach().clone()
    found = Places(torch.rand(6, 3), torch.rand(6, 3), 0.5)
    monkeypatch.setattr(streaming, "find_places", lambda *_: found)
    trainer._place(layer)
    own = layer.newest
    assert torch.equal(own.means[10:16], found.means)
    assert torch.equal(own.means[:10], there[:10]) and torch.equal(own.means[16:], there[16:])
    torch.testing.assert_close(own.sh[10:16, 0] * SH_C0 + 0.5, found.colours)
    assert (own.logit_opacities[10:16].sigmoid() - BEGIN).abs().max() < 1e-6
    sizes = spacing(found.means)
    assert (sizes > 0.25).any()
    torch.testing.assert_close(own.log_scales[10:16, 0], sizes.clamp(max=0.25).log())
    assert not layer.faded()[:16].any() and layer.faded()[16:].all()


def test_one_that_is_not_finite_is_hidden_and_has_no_momentum(rig: Path) -> None:
    trainer = stream_trainer(rig, NEWCOMERS)
    through(trainer, 1)
    trainer.begin_next()
    while trainer.clock.step < FIRST + EACH - 2:
        trainer.step()
    layer = newcomers_of(trainer)
    layer.newest.means.data[3, 1] = torch.nan
    layer.newest.sh.data[4] = torch.inf
    trainer._mend()
    assert all(tensor.isfinite().all() for tensor in layer.newest.tensors().values())
    assert (layer.newest.logit_opacities[3:5].sigmoid() < 1e-6).all()
    assert not trainer.optimizer.first[OWN + "means"][3:5].any()
    trainer.step()
    assert all(tensor.isfinite().all() for tensor in trainer.model.tensors().values())


def test_neighbours_are_not_held_to_them(rig: Path) -> None:
    trainer = stream_trainer(rig, NEWCOMERS)
    through(trainer, 2)
    count = len(trainer.model.splats) - COUNT
    assert {len(one) for one in trainer._compared()} == {count}


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["layers=[{name: newcomers}]", "stream.enabled=false", "motion={name: static}"], "add --"),
        (["layers=[{name: newcomers, count: 0}]"], "count is 0; allowed: 1 or more"),
        (["layers=[{name: newcomers, noticed: 1}]"], "noticed is 1.*; allowed: above 0, below 1"),
        (["layers=[{name: newcomers, rate: 1}]"], "rate"),
    ],
)
def test_bad_options_are_named(options: list[str], problem: str) -> None:
    with pytest.raises(UsageError, match=problem):
        check_plugins(preset_of(*options))
