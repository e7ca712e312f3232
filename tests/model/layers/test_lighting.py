"""Colours that follow how splats have turned."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from kernel_checks import generator
from layer_checks import started_layer, with_and_without
from motion_checks import splats_of
from scipy.spatial.transform import Rotation
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.model.layer import Instant, Layer

COUNT = 6


def lighting(count: int = COUNT) -> Layer:
    layer = started_layer("lighting", count)
    with torch.no_grad():
        layer.tensors()["slopes"].copy_(torch.randn(count, 3, 3, generator=generator(4)))
    return layer


def turned(rotations: Rotation, sign: float = 1.0) -> Moment:
    """Return splats that have turned in the world; SciPy's quaternions have the real part last."""
    splats = splats_of(COUNT)
    own = Rotation.from_quat(splats.quats.roll(-1, 1).numpy())
    quats = sign * torch.tensor((rotations * own).as_quat()).roll(1, 1).float()
    return Moment(replace(splats, quats=quats * 1.7), canonical_quats=splats.quats)


def added(layer: Layer, moment: Moment) -> Tensor:
    """Return what a layer adds to the constant harmonics, which is all that it may change."""
    before, after = moment.splats, layer.at(moment, Instant(0.3)).splats
    for name in ("means", "quats", "log_scales", "logit_opacities"):
        assert getattr(after, name) is getattr(before, name)
    assert torch.equal(after.sh[:, 1:], before.sh[:, 1:])
    return after.sh[:, 0] - before.sh[:, 0]


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["q", "-q"])
@pytest.mark.parametrize("angle", [0.0, 0.01, 1.0, 3.0])
def test_colours_change_by_the_axis_and_half_the_angle(angle: float, sign: float) -> None:
    layer, axes = lighting(), torch.randn(COUNT, 3, generator=generator(2)).double()
    axes = axes / axes.norm(dim=1, keepdim=True)
    moment = turned(Rotation.from_rotvec(angle * axes.numpy()), sign)
    slopes = layer.tensors()["slopes"].detach().double()
    expected = 2 * math.sin(angle / 2) * (axes[:, :, None] * slopes).sum(dim=1)
    torch.testing.assert_close(added(layer, moment).double(), expected, atol=1e-5, rtol=1e-5)


def test_slopes_learn_and_turns_do_not() -> None:
    layer, axis = lighting(), torch.tensor([0.0, 0.6, 0.8])
    moment = turned(Rotation.from_rotvec(0.5 * axis.repeat(COUNT, 1).numpy()))
    quats = moment.splats.quats.requires_grad_()
    sh = layer.at(moment, Instant(0.3)).splats.sh
    weights = torch.randn(sh.shape, generator=generator(5))
    (sh * weights).sum().backward()
    expected = 2 * math.sin(0.25) * axis[None, :, None] * weights[:, :1]
    torch.testing.assert_close(layer.tensors()["slopes"].grad, expected, atol=1e-6, rtol=1e-5)
    assert quats.grad is None


def test_in_a_model_the_motion_turns_and_what_stands_still_keeps_its_colours() -> None:
    moving = 4
    lit, unlit = with_and_without(lighting(moving), COUNT, moving)
    apart = (lit.sh - unlit.sh)[:, 0].abs().amax(dim=1)
    assert (apart[:moving] > 1e-4).all() and not apart[moving:].any()
    assert torch.equal(lit.means, unlit.means)


def test_a_new_layer_changes_nothing() -> None:
    layer = started_layer("lighting", COUNT)
    moment = turned(Rotation.random(COUNT, random_state=0))
    assert not added(layer, moment).any() and layer.identity_at_start


def test_slopes_of_other_shapes_are_refused() -> None:
    layer = lighting()
    (parameter,) = layer.parameters()
    parameter.set_values(torch.zeros(COUNT, 2, 3))
    with pytest.raises(ValueError, match=r"slopes of shape \(6, 2, 3\)"):
        layer.check()
