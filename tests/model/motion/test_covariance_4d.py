"""Gaussians in space and time: slices against their closed form, and splitting in time."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from kernel_checks import generator
from motion_checks import (
    disturbed,
    model_of,
    moved_by,
    pruned_to,
    splats_of,
    stand_still,
    started,
)
from seam_checks import assert_trains_the_same_in_all_ways
from torch import Tensor
from torch.nn.functional import normalize

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.ground.geometry import covariance, scaled_axes
from gsdmsr_cli.model.layer import Instant, Layer
from gsdmsr_cli.model.motion.covariance_4d import Covariance4D
from gsdmsr_cli.raster import load_engine
from gsdmsr_cli.scene.camera import Camera, look_at

NAME, COUNT, SHRINK = "covariance_4d", 5, 1.6


def doubled(motion: Layer, splats: Splats) -> tuple[Layer, Splats]:
    """Return both with values of 64 bits."""
    for parameter in motion.parameters():
        parameter.set_values(parameter.tensor.double())
    return motion, splats.map(Tensor.double)


def product(a: Tensor, b: Tensor) -> Tensor:
    """Return the Hamilton product of two quaternions (4,)."""
    scalar = a[0] * b[0] - a[1:] @ b[1:]
    vector = a[0] * b[1:] + b[0] * a[1:] + torch.linalg.cross(a[1:], b[1:])
    return torch.cat([scalar[None], vector])


def space_time_covariance(motion: Layer, splats: Splats, row: int) -> Tensor:
    """Return S (4, 4) of one splat, time first: axes turned by v -> a v b, as in the paper."""
    own = motion.tensors()
    a = normalize(splats.quats[row], dim=0)
    conjugate = a * a.new_tensor([1.0, -1.0, -1.0, -1.0])
    b = product(conjugate, normalize(own["tilts"][row], dim=0))
    turned = [product(product(a, v), b) for v in torch.eye(4, dtype=a.dtype)]
    scales = torch.cat([own["log_durations"][row, None], splats.log_scales[row]]).exp()
    axes = torch.stack(turned, dim=1) * scales
    return axes @ axes.T


@torch.no_grad()
@pytest.mark.parametrize("time", [0.0, 0.37, 1.0])
def test_what_is_drawn_is_the_gaussian_conditioned_on_time(time: float) -> None:
    options = {"duration": 0.2, "colour_harmonics": 2}
    motion, splats = doubled(disturbed(started(NAME, COUNT, **options)), splats_of(COUNT))
    found, own = motion.at(Moment(splats), Instant(time)), motion.tensors()
    assert found.axes is not None
    for i in range(COUNT):
        s, since = space_time_covariance(motion, splats, i), time - own["times"][i]
        mean = splats.means[i] + s[1:, 0] / s[0, 0] * since
        torch.testing.assert_close(found.splats.means[i], mean)
        conditional = s[1:, 1:] - torch.outer(s[1:, 0], s[0, 1:]) / s[0, 0]
        torch.testing.assert_close(found.axes[i] @ found.axes[i].T, conditional)
        opacity = splats.logit_opacities[i].sigmoid() * torch.exp(-(since**2) / (2 * s[0, 0]))
        torch.testing.assert_close(found.splats.logit_opacities[i].sigmoid(), opacity)
        waves = [torch.cos(2 * math.pi * n * since) * own["sh"][i, n - 1] for n in (1, 2)]
        torch.testing.assert_close(found.splats.sh[i], splats.sh[i] + sum(waves))


@torch.no_grad()
def test_splats_that_are_not_tilted_stand_still_and_are_what_they_would_be_without_time() -> None:
    motion, splats = doubled(started(NAME, COUNT), splats_of(COUNT))
    moment = motion.at(Moment(splats), Instant(0.2))
    assert moment.axes is not None
    assert torch.equal(moment.splats.means, splats.means)
    expected = covariance(splats.quats, splats.log_scales)
    torch.testing.assert_close(moment.axes @ moment.axes.mT, expected)


def test_gradients_are_those_of_finite_differences() -> None:
    options = {"duration": 0.2, "colour_harmonics": 1}
    motion, splats = doubled(disturbed(started(NAME, 2, **options)), splats_of(2))
    given = [*motion.tensors().values(), *splats.tensors().values()]

    def drawn(*_: Tensor) -> tuple[Tensor, ...]:
        moment = motion.at(Moment(splats), Instant(0.3))
        assert moment.axes is not None
        return moment.splats.means, moment.splats.logit_opacities, moment.splats.sh, moment.axes

    assert torch.autograd.gradcheck(drawn, [tensor.requires_grad_() for tensor in given])


@torch.no_grad()
def test_children_are_drawn_from_the_extent_in_time_and_go_along_with_their_parents() -> None:
    """Of one Gaussian and 4000 children: what they are spread by is its deviation in time."""
    count, duration = 4001, 0.2
    motion = started(NAME, count, duration=duration)
    own, splats = motion.tensors(), splats_of(1).take(torch.zeros(count, dtype=torch.int64))
    own["times"].fill_(0.5)
    own["tilts"][:, 1] = 0.4
    before = moved_by(motion, splats, 0.5).means
    slope = moved_by(motion, splats, 1.5).means - before
    variance = space_time_covariance(*doubled(motion, splats.map(torch.clone)), 0)[0, 0]
    motion = started(NAME, count, duration=duration)
    own = motion.tensors()
    own["times"].fill_(0.5)
    own["tilts"][:, 1] = 0.4
    children = torch.arange(count) > 0
    motion.scatter(children, splats, SHRINK, generator())
    later = own["times"] - 0.5
    assert later[0] == 0 and own["log_durations"][0].item() == pytest.approx(math.log(duration))
    assert later[1:].std().item() == pytest.approx(float(variance.sqrt()), rel=0.05)
    assert later[1:].mean().item() == pytest.approx(0.0, abs=0.02)
    torch.testing.assert_close(splats.means, before + later[:, None] * slope, atol=1e-5, rtol=0)
    shrunk = torch.full((count - 1,), math.log(duration / SHRINK))
    torch.testing.assert_close(own["log_durations"][1:], shrunk)


@torch.no_grad()
def test_splats_that_stand_still_are_drawn_by_their_own_rotations_and_scales() -> None:
    splats = splats_of(COUNT)
    model = model_of(splats, disturbed(started(NAME, COUNT)))
    before = model.at(model.instant(0.3))
    assert before.axes is not None
    order = stand_still(model, torch.arange(COUNT) == 1, splats)
    found = model.at(model.instant(0.3))
    assert order == [0, 2, 3, 4, 1] and found.axes is not None
    assert torch.equal(found.axes[:4], before.axes[order[:4]])
    assert torch.equal(found.axes[4], scaled_axes(splats.quats, splats.log_scales)[1])


@torch.no_grad()
def test_the_engine_of_the_cpu_draws_slices_as_the_reference_does() -> None:
    pose = look_at(np.array([4.0, 1.0, 1.5]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    camera, white = Camera(pose, 40.0, 40.0, 16.0, 12.0, 32, 24), torch.ones(3)
    splats = replace(splats_of(40), log_scales=splats_of(40).log_scales + 1)
    moment = disturbed(started(NAME, 40, duration=0.5)).at(Moment(splats), Instant(0.4))
    found, expected = (
        load_engine(name).rasterize(moment, camera, white).rgb for name in ("cpu", "reference")
    )
    assert float((expected - 1).abs().max()) > 0.2
    torch.testing.assert_close(found, expected, atol=2e-3, rtol=0)


def test_splats_that_are_long_in_time_are_to_be_split() -> None:
    motion = started(NAME, 3, duration=0.2, split_duration=0.1)
    assert isinstance(motion, Covariance4D)
    with torch.no_grad():
        motion.tensors()["log_durations"][1] = math.log(0.09)
    assert motion.to_split().tolist() == [True, False, True]


@torch.no_grad()
def test_density_control_prunes_what_has_left_the_capture() -> None:
    """But not what is seen at its end, nor what stands still there."""
    splats, motion = splats_of(COUNT), started(NAME, 4, duration=0.05)
    splats.logit_opacities.fill_(2.0)
    motion.tensors()["times"].copy_(torch.tensor([0.5, -0.4, 1.04, 1.5]))
    model = model_of(splats, motion, moving=4)
    assert pruned_to(model) == [0, 2, 4]
    found = model.highest_opacities().sigmoid()
    torch.testing.assert_close(found[[0, 4]], torch.sigmoid(torch.tensor([2.0, 2.0])))
    assert found[2].item() == pytest.approx(0.8808 * math.exp(-0.32), rel=1e-3)


def test_times_that_are_known_are_begun_with() -> None:
    motion = started(NAME, 2)
    spread = motion.tensors()["times"].detach().clone()
    motion.begin_at(torch.tensor([0.25, math.nan]))
    assert motion.tensors()["times"].tolist() == [0.25, float(spread[1])]


@pytest.mark.parametrize(
    ("options", "found"),
    [
        ({"duration": 0.0}, "duration is 0.0; allowed: a number above 0"),
        ({"split_duration": -1.0}, "split_duration is -1.0; allowed: a number above 0"),
        ({"colour_harmonics": -1}, "colour_harmonics is -1; allowed: 0 or more"),
        ({"tilt_rate": [0.0, 1.0]}, "tilt_rate is .*; allowed: .start, end., both above 0"),
    ],
)
def test_options_out_of_range_are_refused(options: dict[str, float], found: str) -> None:
    with pytest.raises(UsageError, match=found):
        started(NAME, 1, **options)


def test_it_trains_with_workers_without_and_resumed(tiny_scene: Path, tmp_path: Path) -> None:
    trainer = assert_trains_the_same_in_all_ways(
        tiny_scene, tmp_path, f"motion={{name: {NAME}, colour_harmonics: 1}}"
    )
    own = trainer.model.layers["motion"].tensors()
    assert {len(tensor) for tensor in own.values()} == {200}  # splats have grown
    assert own["log_durations"].min() < math.log(0.12)  # and some were split in time
    assert own["sh"].any() and own["tilts"][:, 1:].any()
