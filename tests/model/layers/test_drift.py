"""Drift: the closed form, its regulariser, splats that stand still, and bad options."""

from __future__ import annotations

import math

import pytest
import torch
from layer_checks import started_layer
from motion_checks import FACTS, disturbed, splats_of, stand_still

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model import layers
from gsdmsr_cli.model.building import start_model
from gsdmsr_cli.model.layer import Instant, options_of

COUNT = 6


def test_it_is_its_formula() -> None:
    """x + (t - 1/2) d, d in units of the bound; all else stays."""
    layer, splats = disturbed(started_layer("drift", COUNT)), splats_of(COUNT)
    for time in (0.0, 0.5, 0.8):
        after = layer.at(Moment(splats), Instant(time)).splats
        expected = splats.means + (time - 0.5) * FACTS.bound * layer.tensors()["ways"]
        torch.testing.assert_close(after.means, expected)
        assert after.quats is splats.quats and after.logit_opacities is splats.logit_opacities


def test_few_long_ways_are_preferred_to_many_short_ones() -> None:
    """By the mean of log(|d| + 0.001), which has a gradient where a way is 0 as well."""
    layer = started_layer("drift", 2, sparsity=0.5)
    ways = layer.tensors()["ways"]
    ways.data[0] = torch.tensor([0.03, 0.0, 0.04])
    found = layer.penalty(Moment(splats_of(2)), Instant(0.5), torch.Generator())
    assert found is not None
    assert found.item() == pytest.approx(0.25 * (math.log(0.051) + math.log(0.001)), rel=1e-5)
    found.backward()
    assert ways.grad is not None and ways.grad.isfinite().all() and ways.grad[0].any()


@torch.no_grad()
def test_splats_that_stand_still_drift_too() -> None:
    given = splats_of(COUNT), {"name": "keyframes"}, [{"name": "drift"}], FACTS
    model = start_model(*given, torch.Generator())
    stand_still(model, torch.arange(COUNT) >= 2, model.splats.detach())
    model.tensors()["layers.drift.ways"].fill_(0.1)
    first, last = (model.at(model.instant(time)).splats.means for time in (0.0, 1.0))
    torch.testing.assert_close(last - first, torch.full((COUNT, 3), 0.1 * FACTS.bound))


@pytest.mark.parametrize(
    ("option", "value", "allowed"),
    [("sparsity", -1, "0 or more"), ("rate", [0, 1e-3], r"\[start, end\], both above 0")],
)
def test_options_out_of_range_are_refused(option: str, value: object, allowed: str) -> None:
    with pytest.raises(UsageError, match=f"^layers: {option} is .*; allowed: {allowed}$"):
        options_of(layers.__name__, {"name": "drift", option: value})
