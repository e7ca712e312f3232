"""Life spans: the closed form, gradients, training them in all ways, and bad options."""

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

COUNT = 6


@pytest.mark.parametrize("time", [0.0, 0.05, 0.5, 0.97])
def test_it_is_its_formula(time: float) -> None:
    """1 between two times; before and after, exp(-(how far / how long)^2)."""
    layer, splats = disturbed(started_layer("life_span", COUNT, duration=0.2)), splats_of(COUNT)
    layer.starts.data[0], layer.ends.data[0] = 0.6, 0.3  # whichever comes first
    found = layer.at(Moment(splats), Instant(time)).splats.logit_opacities.double().sigmoid()
    own = {name: t.detach().double().tolist() for name, t in layer.tensors().items()}
    for i in range(COUNT):
        first, last = sorted((own["starts"][i], own["ends"][i]))
        early, late = (torch.tensor(own[f"log_{n}"][i]).exp() for n in ("appearing", "vanishing"))
        away = max(first - time, 0) / early + max(time - last, 0) / late
        expected = torch.sigmoid(splats.logit_opacities[i].double()) * torch.exp(-(away**2))
        assert found[i].item() == pytest.approx(expected.item(), rel=1e-5)


@pytest.mark.parametrize("time", [0.02, 0.96])
def test_its_gradients_are_right(time: float) -> None:
    layer, splats = disturbed(started_layer("life_span", COUNT)), splats_of(COUNT)
    names = list(layer.tensors())

    def faded(*values: Tensor) -> Tensor:
        for name, value in zip(names, values, strict=True):
            setattr(layer, name, value)
        return layer.at(Moment(splats.map(Tensor.double)), Instant(time)).splats.logit_opacities

    given = [t.detach().double().requires_grad_() for t in layer.tensors().values()]
    assert torch.autograd.gradcheck(faded, given)


def test_hardly_anything_is_hidden_at_the_start() -> None:
    layer, splats = started_layer("life_span", COUNT), splats_of(COUNT)
    for time in (0.0, 0.5, 1.0):
        after = layer.at(Moment(splats), Instant(time)).splats
        ratio = after.logit_opacities.sigmoid() / splats.logit_opacities.sigmoid()
        assert ratio.min() > 0.98


def test_it_trains_with_workers_without_and_resumed(tiny_scene: Path, tmp_path: Path) -> None:
    options = "motion={name: keyframes, keyframes: 3}", "layers=[{name: life_span}, {name: drift}]"
    trainer = assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, *options)
    tensors = trainer.model.tensors()
    for name in ("motion.offsets", "motion.turns", "layers.drift.ways"):
        assert len(tensors[name]) == 200 and tensors[name].any(), name  # it has grown
    assert (tensors["layers.life_span.starts"] != 0.1).any()


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
        options_of(layers.__name__, {"name": "life_span", option: value})
