"""Tensors get few bits that leave what is drawn where it is, within a tolerance of all."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import pytest
import torch
from kernel_checks import generator
from motion_checks import FACTS, disturbed, splats_of, started
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.building import load_model, start_model
from gsdmsr_cli.model.layer import Layer
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.runs import tolerance as tolerance_module
from gsdmsr_cli.runs.packed_values import HALF, RAW, Form, rounded
from gsdmsr_cli.runs.tolerance import MOMENTS, distance, forms_of

COUNT = 60
MOTION = {"name": "control_points", "count": 20, "levels": [8], "channels": 16, "width": 16}


def model_of() -> Model:
    model = start_model(splats_of(COUNT), MOTION, (), FACTS, generator())
    disturbed(model.layers["motion"])
    return model


def drawn(model: Model) -> list[Moment]:
    return [model.at(model.instant(i / (MOMENTS - 1))) for i in range(MOMENTS)]


def distance_at(model: Model, forms: Mapping[str, Form]) -> float:
    """Return it by a model of its own, which cannot remember anything of other values."""
    tensors = {key: tensor.detach().clone() for key, tensor in model.tensors().items()}
    for name, form in forms.items():
        tensors[name] = torch.from_numpy(rounded(tensors[name].numpy(), form))
    with torch.no_grad():
        return distance(drawn(model), drawn(load_model(tensors, MOTION, (), FACTS, 1.0)))


@pytest.mark.parametrize("tolerance", [0.01, 0.1])
def test_bits_keep_to_the_tolerance_and_are_not_many_more(tolerance: float) -> None:
    """Fewer by two of each tensor would not."""
    model = model_of()
    before = {name: tensor.detach().clone() for name, tensor in model.tensors().items()}
    found = forms_of(model, tolerance, model.trained().keys())
    assert all(torch.equal(tensor, before[name]) for name, tensor in model.tensors().items())
    assert found.keys() == model.trained().keys() and len(set(found.values())) > 3
    assert all(form.kind == "steps" for form in found.values())
    assert distance_at(model, found) <= tolerance
    coarser = {name: Form("steps", form.bits - 2) for name, form in found.items()}
    assert distance_at(model, coarser) > tolerance


def test_the_tolerance_is_that_of_all_tensors_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Here all are off as each is, in the same direction: shares are halved until they do."""
    model, asked = model_of(), []

    def off(model: Model, forms: Mapping[str, Form], exact: list[Moment]) -> float:
        asked.append(len(forms))
        return sum(2.0 ** -(form.bits or 20) for form in forms.values())

    monkeypatch.setattr(tolerance_module, "_off", off)
    names = list(model.trained())
    found = forms_of(model, 0.1, names)
    assert off(model, found, []) <= 0.1
    assert asked.count(len(names)) > 2
    assert off(model, found, []) > 0.02


def test_where_no_rounding_does_nothing_is_rounded() -> None:
    model = model_of()
    assert set(forms_of(model, 0.0, model.trained().keys()).values()) == {RAW}


def test_what_nothing_shows_of_has_halves() -> None:
    """A network that makes colours after drawing."""
    model = start_model(
        splats_of(COUNT), {"name": "static"}, [{"name": "decoder"}], FACTS, generator()
    )
    disturbed(model.layers["layers.decoder"])
    found = forms_of(model, 0.05, model.trained().keys())
    of_network = {name for name in found if name.startswith("layers.decoder.network")}
    assert of_network and all(found[name] == HALF for name in of_network)
    assert found["splats.quats"].kind == found["layers.decoder.directions"].kind == "steps"


@pytest.mark.parametrize(("far", "expected"), [(3e4, HALF), (1e6, RAW)])
def test_where_steps_are_too_coarse_there_are_halves_and_where_these_are_float32(
    far: float, expected: Form
) -> None:
    """Positions of which one is far away; halves are as fine as they are near 0."""
    splats = splats_of(COUNT)
    splats.means.mul_(0.01)[0] = far
    model = start_model(splats, {"name": "static"}, (), FACTS, generator())
    assert forms_of(model, 0.02, ["splats.means"]) == {"splats.means": expected}


def test_equal_values_take_the_least_bits() -> None:
    model = model_of()
    model.splats.sh.data.fill_(0.3)
    assert forms_of(model, 0.0, ["splats.sh"]) == {"splats.sh": Form("steps", 4)}


@torch.no_grad()
def test_what_is_compared_is_drawn_by_the_values_that_tensors_have_now() -> None:
    """A motion remembers which control points splats follow, and must find them anew."""
    model = model_of()
    tolerance_module._drawn(model)
    model.splats.means.neg_()
    tensors = {key: tensor.clone() for key, tensor in model.tensors().items()}
    fresh = load_model(tensors, MOTION, (), FACTS, 1.0)
    assert distance(drawn(fresh), tolerance_module._drawn(model)) == 0


def one(**changed: Tensor) -> list[Moment]:
    """Return a splat of size 0.1 and opacity 1/2, with other values."""
    splats = Splats(
        means=torch.zeros(1, 3),
        quats=torch.tensor([[2.0, 0, 0, 0]]),
        log_scales=torch.full((1, 3), math.log(0.1)),
        logit_opacities=torch.zeros(1),
        sh=torch.zeros(1, 4, 3),
    )
    return [Moment(replace(splats, **changed))]


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"means": torch.tensor([[0.0, 0.01, 0.0]])}, 0.1),
        ({"means": torch.tensor([[0.0, 9.0, 0.0]])}, 1.0),
        ({"quats": torch.tensor([[math.cos(0.05), math.sin(0.05), 0, 0]])}, 0.1),
        ({"log_scales": torch.full((1, 3), math.log(0.1) + 0.2)}, 0.2 * 3**0.5),
        ({"logit_opacities": torch.tensor([math.log(3)])}, 0.25),
        ({"sh": torch.tensor([[[1.0, 0, 0]] + [[0.0, 0, 0]] * 3])}, 0.28209479),
    ],
    ids=lambda each: next(iter(each)) if isinstance(each, dict) else str(each),
)
def test_distances_are_in_units_of_what_is_seen(
    changed: dict[str, Tensor], expected: float
) -> None:
    assert distance(one(), one(**changed)) == pytest.approx(expected, rel=1e-3)
    assert distance(one(), one()) == 0


def test_axes_and_features_count_where_there_are_such() -> None:
    (bare,) = one()
    axes, features = 0.1 * torch.eye(3)[None], torch.zeros(1, 2)
    exact = replace(bare, axes=axes, features=features)
    assert distance([exact], [replace(exact, axes=1.1 * axes)]) == pytest.approx(0.1 * 3**0.5)
    assert distance([exact], [replace(exact, features=features + 0.3)]) == pytest.approx(
        0.3 * 2**0.5
    )


def test_a_splat_counts_by_its_opacity_and_size() -> None:
    splats = splats_of(2)
    splats.log_scales[:] = torch.tensor([[-2.0], [-3.0]])
    splats.logit_opacities[:] = torch.tensor([0.0, 2.0])
    weights = torch.tensor([math.exp(-2) * 0.5, math.exp(-3) / (1 + math.exp(-2))])
    for row in (0, 1):
        other = splats.map(torch.clone)
        other.log_scales[row, 0] += 0.1
        expected = 0.1 * math.sqrt(weights[row] / weights.sum())
        assert distance([Moment(splats)], [Moment(other)]) == pytest.approx(expected, rel=1e-4)


def test_a_layer_that_wants_a_camera_gets_one() -> None:
    layer: Layer = disturbed(started("static", COUNT))
    layer.needs_camera = True  # type: ignore[misc]
    model = Model(splats_of(COUNT), {"motion": layer})
    assert "splats.means" in forms_of(model, 0.02, ["splats.means"])
