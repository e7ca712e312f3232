"""Splats that vibrate and live for a while, against the closed form."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from kernel_checks import generator
from motion_checks import FACTS, disturbed, model_of, moved_by, pruned_to, splats_of, started
from seam_checks import assert_trains_the_same_in_all_ways
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model.layer import Instant, Layer

NAME, COUNT, SHRINK = "vibration", 5, 1.6
OPTIONS = {"period": 0.7, "life_span": 0.2, "smoothing": 1.5}


def doubled(motion: Layer, splats: Splats) -> tuple[Layer, Splats]:
    """Return both with values of 64 bits."""
    for parameter in motion.parameters():
        parameter.set_values(parameter.tensor.double())
    return motion, splats.map(Tensor.double)


@torch.no_grad()
@pytest.mark.parametrize("time", [0.0, 0.37, 1.0])
@pytest.mark.parametrize("jitter", [0.0, 0.8])
def test_splats_are_where_the_papers_equations_say(time: float, jitter: float) -> None:
    """With a jitter, those of a little earlier, moved on at the mean velocity v exp(-rho / 2)."""
    motion, splats = doubled(disturbed(started(NAME, COUNT, **OPTIONS)), splats_of(COUNT))
    moved = motion.at(Moment(splats), Instant(time, jitter=jitter)).splats
    own, later = motion.tensors(), 1.5 * jitter / (FACTS.frames - 1)
    for i in range(COUNT):
        velocity, span = FACTS.bound * own["velocities"][i], own["log_life_spans"][i].exp()
        since, turn = time - later - own["peaks"][i], 2 * math.pi / 0.7
        mean = velocity * torch.exp(-span / 0.7 / 2)
        expected = splats.means[i] + velocity * torch.sin(turn * since) / turn + later * mean
        torch.testing.assert_close(moved.means[i], expected)
        opacity = splats.logit_opacities[i].sigmoid() * torch.exp(-((since / span) ** 2) / 2)
        torch.testing.assert_close(moved.logit_opacities[i].sigmoid(), opacity)
    for name in ("quats", "log_scales", "sh"):
        assert getattr(moved, name) is getattr(splats, name)


def test_gradients_are_those_of_finite_differences() -> None:
    motion, splats = doubled(disturbed(started(NAME, 3, **OPTIONS)), splats_of(3))
    given = [*motion.tensors().values(), splats.means, splats.logit_opacities]

    def drawn(*_: Tensor) -> tuple[Tensor, ...]:
        moved = motion.at(Moment(splats), Instant(0.3, jitter=0.4)).splats
        return moved.means, moved.logit_opacities

    assert torch.autograd.gradcheck(drawn, [tensor.requires_grad_() for tensor in given])


@torch.no_grad()
def test_children_begin_on_their_parents_way_with_the_velocity_there() -> None:
    count = 4001
    motion, splats = started(NAME, count, **OPTIONS), splats_of(1).take(torch.zeros(count).long())
    own = motion.tensors()
    own["peaks"].fill_(0.5)
    own["velocities"].copy_(torch.tensor([0.3, -0.2, 0.1]))
    parent, ends = moved_by(motion, splats, 0.5).means[0], splats.map(torch.clone)
    motion.scatter(torch.arange(count) > 0, splats, SHRINK, generator())
    later = own["peaks"] - 0.5
    assert later[0] == 0 and torch.equal(splats.means[0], parent)
    assert later[1:].std().item() == pytest.approx(0.2, rel=0.05)
    shrunk = torch.full((count - 1,), math.log(0.2 / SHRINK))
    torch.testing.assert_close(own["log_life_spans"][1:], shrunk)
    before = started(NAME, 1, **OPTIONS)
    before.tensors()["peaks"].fill_(0.5)
    before.tensors()["velocities"].copy_(own["velocities"][:1])
    for row in (1, 2, 3):
        there = float(own["peaks"][row])
        on, after = (moved_by(before, ends.take(torch.tensor([0])), there + d).means[0]
                     for d in (0.0, 1e-3))  # fmt: skip
        torch.testing.assert_close(splats.means[row], on, atol=1e-5, rtol=0)
        slope = FACTS.bound * own["velocities"][row]
        torch.testing.assert_close((after - on) / 1e-3, slope, atol=5e-3, rtol=0)


def test_splats_with_a_long_life_are_to_be_split() -> None:
    motion = started(NAME, 3, life_span=0.2, split_life_span=0.1)
    with torch.no_grad():
        motion.tensors()["log_life_spans"][1] = math.log(0.09)
    split = motion.to_split()
    assert split is not None and split.tolist() == [True, False, True]


@torch.no_grad()
def test_density_control_prunes_what_has_left_the_capture() -> None:
    splats, motion = splats_of(4), started(NAME, 4, life_span=0.05)
    splats.logit_opacities.fill_(2.0)
    motion.tensors()["peaks"].copy_(torch.tensor([0.5, -0.4, 1.04, 1.5]))
    model = model_of(splats, motion)
    assert pruned_to(model) == [0, 2]
    found = model.highest_opacities().sigmoid()
    assert found[2].item() == pytest.approx(0.8808 * math.exp(-0.32), rel=1e-3)


def test_peaks_are_where_splats_were_seen_if_that_is_known() -> None:
    motion = started(NAME, 2)
    motion.begin_at(torch.tensor([0.25, math.nan]))
    assert motion.tensors()["peaks"][0] == 0.25 and motion.tensors()["peaks"][1].isfinite()


@pytest.mark.parametrize(
    ("options", "found"),
    [
        ({"period": 0.0}, "period is 0.0; allowed: a number above 0"),
        ({"life_span": -1.0}, "life_span is -1.0; allowed: a number above 0"),
        ({"split_life_span": 0.0}, "split_life_span is 0.0; allowed: a number above 0"),
        ({"smoothing": -0.1}, "smoothing is -0.1; allowed: 0 or more"),
        ({"rate": [0.0, 1.0]}, "rate is .*; allowed: .start, end., both above 0"),
    ],
)
def test_options_out_of_range_are_refused(options: dict[str, float], found: str) -> None:
    with pytest.raises(UsageError, match=found):
        started(NAME, 1, **options)


def test_it_trains_with_workers_without_and_resumed(tiny_scene: Path, tmp_path: Path) -> None:
    """Before a sky, which shades after drawing."""
    trainer = assert_trains_the_same_in_all_ways(
        tiny_scene, tmp_path, f"motion={{name: {NAME}}}", "layers=[{name: sky, resolution: 4}]"
    )
    own = trainer.model.layers["motion"].tensors()
    assert {len(tensor) for tensor in own.values()} == {200}  # splats have grown
    assert own["log_life_spans"].min() < math.log(0.15)  # and some were split in time
    assert own["velocities"].any()
    assert trainer.model.layers["layers.sky"].tensors()["colours"].any()
