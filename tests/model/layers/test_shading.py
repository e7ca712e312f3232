"""Brightness of splats that changes in time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from kernel_checks import generator
from layer_checks import started_layer, with_and_without
from motion_checks import splats_of
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.model.layer import Instant, Layer

COUNT, NODES = 6, 5


def shading(count: int = COUNT, since: float = 0.5) -> Layer:
    layer = started_layer("shading", count, nodes=NODES, since=since)
    with torch.no_grad():
        layer.tensors()["gains"].copy_(0.3 * torch.randn(count, NODES, generator=generator(4)))
    return layer


def colours(sh: Tensor, functions: Tensor) -> Tensor:
    """Return colours (N, 3) by harmonics whose functions have these values (K,) somewhere."""
    return 0.5 + (sh.double() * functions[:, None]).sum(dim=1)


@pytest.mark.parametrize("time", [0.0, 0.1, 0.25, 0.61, 1.0])
def test_all_colours_become_brighter_by_a_line_between_nodes(time: float) -> None:
    layer, splats = shading(), splats_of(COUNT)
    own = layer.tensors()["gains"].detach().double().numpy()
    gains = torch.tensor([np.interp(time, np.linspace(0, 1, NODES), row) for row in own])
    after = layer.at(Moment(splats), Instant(time)).splats
    functions = torch.randn(splats.sh.shape[1], generator=generator(6)).double()
    functions[0] = SH_C0
    expected = colours(splats.sh, functions) * (1 + gains[:, None])
    torch.testing.assert_close(
        colours(after.sh.detach(), functions), expected, atol=1e-5, rtol=1e-5
    )
    for name in ("means", "quats", "log_scales", "logit_opacities"):
        assert getattr(after, name) is getattr(splats, name)


def test_gains_and_colours_learn() -> None:
    layer, splats = shading(), splats_of(COUNT)
    gains = layer.tensors()["gains"]
    sh = splats.sh.clone().requires_grad_()
    weights = torch.randn(sh.shape, generator=generator(5))

    def loss() -> Tensor:
        moment = Moment(replace(splats, sh=sh))
        return (layer.at(moment, Instant(0.3)).splats.sh * weights).sum()

    loss().backward()
    white = torch.zeros_like(sh)
    white[:, 0] = 0.5 / SH_C0
    by_gain = ((sh.detach() + white) * weights).sum(dim=(1, 2))
    shares = torch.tensor([0.0, 0.8, 0.2, 0.0, 0.0])
    torch.testing.assert_close(gains.grad, by_gain[:, None] * shares, atol=1e-5, rtol=1e-5)
    factors = 1 + (gains.detach() @ shares)[:, None, None]
    torch.testing.assert_close(sh.grad, weights * factors, atol=1e-6, rtol=1e-5)


def test_moments_at_once_are_as_one_by_one() -> None:
    layer, given = shading(), [Moment(splats_of(COUNT, seed=seed)) for seed in (1, 2)]
    instants = [Instant(0.15), Instant(0.8)]
    weights = torch.randn(given[0].splats.sh.shape, generator=generator(5))
    found = []
    for after in (
        layer.at_moments(given, instants),
        [layer.at(moment, now) for moment, now in zip(given, instants, strict=True)],
    ):
        (gradient,) = torch.autograd.grad(
            sum(((moment.splats.sh * weights).sum() for moment in after), torch.zeros(())),
            layer.tensors()["gains"],
        )
        found.append([*(moment.splats.sh.detach() for moment in after), gradient])
    torch.testing.assert_close(*found)
    apart = layer.at_instants(given[0], instants)
    assert not torch.equal(apart[0].splats.sh, apart[1].splats.sh)


def test_before_it_is_learnt_nothing_changes() -> None:
    layer, moment = shading(since=0.4), Moment(splats_of(COUNT))
    layer.advance(0.39)
    assert layer.at(moment, Instant(0.3)) is moment
    layer.advance(0.4)
    assert not torch.equal(layer.at(moment, Instant(0.3)).splats.sh, moment.splats.sh)


def test_in_a_model_what_stands_still_keeps_its_colours() -> None:
    moving = 4
    shaded, as_it_was = with_and_without(shading(moving), COUNT, moving)
    apart = (shaded.sh - as_it_was.sh)[:, 0].abs().amax(dim=1)
    assert (apart[:moving] > 1e-4).all() and not apart[moving:].any()


def test_less_than_two_nodes_are_refused() -> None:
    with pytest.raises(UsageError, match="2 or more"):
        started_layer("shading", COUNT, nodes=1)


def test_gains_of_one_time_are_refused() -> None:
    layer = shading()
    (parameter,) = layer.parameters()
    parameter.set_values(torch.zeros(COUNT, 1))
    with pytest.raises(ValueError, match="gains of shape"):
        layer.check()
