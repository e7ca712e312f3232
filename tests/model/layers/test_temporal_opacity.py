"""Temporal opacity: the closed form, gradients, training it in all ways, and bad options."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from layer_checks import started_layer
from motion_checks import disturbed, splats_of
from seam_checks import assert_trains_the_same_in_all_ways
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model import layers
from gsdmsr_cli.model.layer import Instant, options_of

COUNT, TIME = 6, 0.4


def test_it_is_its_formula() -> None:
    """The opacity times exp(-((t - mu) / s)^2); all else stays."""
    layer, splats = disturbed(started_layer("temporal_opacity", COUNT, duration=0.2)), splats_of(6)
    after = layer.at(Moment(splats), Instant(TIME)).splats
    centres, durations = layer.centres.double(), layer.log_durations.double().exp()
    factor = torch.exp(-(((TIME - centres) / durations) ** 2))
    expected = torch.sigmoid(splats.logit_opacities.double()) * factor
    found = torch.sigmoid(after.logit_opacities.double())
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=0)
    for name in ("means", "quats", "log_scales", "sh"):
        assert getattr(after, name) is getattr(splats, name), name


def test_its_gradients_are_right() -> None:
    layer, splats = started_layer("temporal_opacity", COUNT), splats_of(COUNT).map(Tensor.double)

    def faded(centres: Tensor, log_durations: Tensor) -> Tensor:
        layer.centres, layer.log_durations = centres, log_durations
        return layer.at(Moment(splats), Instant(TIME)).splats.logit_opacities

    given = [t.detach().double().requires_grad_() for t in layer.tensors().values()]
    assert torch.autograd.gradcheck(faded, given)


def test_an_opacity_too_short_to_be_seen_stays_finite() -> None:
    layer = started_layer("temporal_opacity", COUNT)
    layer.log_durations.data.fill_(-200.0)
    opacities = layer.at(Moment(splats_of(COUNT)), Instant(TIME)).splats.logit_opacities
    opacities.sum().backward()
    assert opacities.isfinite().all() and opacities.max() < -50
    assert all(t.grad.isfinite().all() for t in layer.tensors().values())


@pytest.mark.parametrize("motion", ["static", "polynomial"])
def test_it_trains_with_workers_without_and_resumed(
    tiny_scene: Path, tmp_path: Path, motion: str
) -> None:
    options = f"motion={{name: {motion}}}", "layers=[{name: temporal_opacity}]"
    trainer = assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, *options)
    tensors = trainer.model.tensors()
    durations = tensors["layers.temporal_opacity.log_durations"]
    assert len(durations) == 200 and durations.any()  # it has grown
    if motion == "polynomial":
        assert tensors["motion.coefficients"].any() and tensors["motion.turns"].any()


@pytest.mark.parametrize(
    ("option", "value", "allowed"),
    [
        ("duration", 0, "above 0"),
        ("centre_rate", [0, 1e-3], r"\[start, end\], both above 0"),
        ("duration_rate", [1e-3, -1], r"\[start, end\], both above 0"),
    ],
)
def test_options_out_of_range_are_refused(option: str, value: object, allowed: str) -> None:
    with pytest.raises(UsageError, match=f"^layers: {option} is .*; allowed: {allowed}$"):
        options_of(layers.__name__, {"name": "temporal_opacity", option: value})
