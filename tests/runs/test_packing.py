"""Packed models draw what they did, take few bytes, and are refused where they are damaged."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from kernel_checks import generator
from motion_checks import FACTS, disturbed, splats_of, started

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.model.building import load_model, start_model
from gsdmsr_cli.model.layers.mask import Mask
from gsdmsr_cli.model.layers.quantise import Quantise
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.runs import packing
from gsdmsr_cli.runs.packing import pack, unpack

COUNT = 200
MASKED = torch.arange(0, COUNT, 10)

MOTION = {"name": "hexplane", "levels": [8], "channels": 16, "width": 16}
LAYERS = (
    {"name": "quantise", "stages": 3, "codes": 32},
    {"name": "mask"},
    {"name": "colour", "levels": 8, "resolutions": [4, 16], "log2_rows": 8, "width": 16},
)


def model_of(moving: int = COUNT) -> Model:
    """Return a model with everything that is packed in a way of its own, trained or nearly so."""
    splats = splats_of(COUNT)
    splats = replace(splats, sh=splats.sh[:, :1])
    model = start_model(splats, MOTION, LAYERS, FACTS, generator(), moving)
    for name, layer in model.layers.items():
        if name not in ("layers.quantise", "layers.mask"):
            disturbed(layer)
    mask, quantise = model.layers["layers.mask"], model.layers["layers.quantise"]
    assert isinstance(mask, Mask) and isinstance(quantise, Quantise)
    with torch.no_grad():
        mask.logits[MASKED] = -9.0
    quantise.fit(model.splats.detach(), generator())
    return model


def drawn(model: Model, time: float) -> Splats:
    """Return what is drawn and shows, in an order of its own: by the first coordinates."""
    splats = model.at(model.instant(time)).splats.detach()
    shown = (splats.logit_opacities > -20).nonzero().flatten()
    order = model.splats.means.detach()[shown].half().float()
    return splats.take(shown[(order[:, 0] * 1000 + order[:, 1]).argsort()])


@pytest.mark.parametrize("moving", [COUNT, 130, 0])
def test_a_packed_model_draws_nearly_what_it_did(moving: int) -> None:
    model = model_of(moving)
    expected = [drawn(model, time) for time in (0.0, 0.7)]
    loaded = load_model(unpack(*pack(model)), MOTION, LAYERS, FACTS, 1.0)
    assert len(loaded.splats) == COUNT - len(MASKED)
    assert loaded.moving == moving - int((moving > MASKED).sum())
    for time, truth in zip((0.0, 0.7), expected, strict=True):
        found = drawn(loaded, time)
        assert torch.equal(found.logit_opacities, truth.logit_opacities)
        for name, tolerance in (
            ("means", 0.02),
            ("quats", 0.02),
            ("log_scales", 0.02),
            ("sh", 0.05),
        ):
            apart = (found.tensors()[name] - truth.tensors()[name]).abs()
            assert apart.max() < tolerance, (name, float(apart.max()))
        if not moving:
            assert torch.equal(found.means, truth.means)


def test_splats_take_a_fifth_of_the_bytes_and_all_a_good_third() -> None:
    """So few: grids and networks of this size have 16 bits a value."""
    model = model_of()
    before = {name: tensor.nbytes for name, tensor in model.tensors().items()}
    packed, _ = pack(model)
    assert packed.keys() == before.keys()
    assert all(tensor.dtype == torch.uint8 for tensor in packed.values())
    after = {name: tensor.nbytes for name, tensor in packed.items()}
    splats = [name for name in before if name.startswith("splats.")]
    assert sum(after[name] for name in splats) < 0.2 * sum(before[name] for name in splats)
    assert sum(after.values()) < 0.4 * sum(before.values())


def test_a_model_without_further_layers_is_packed_as_well() -> None:
    model = Model(splats_of(50), {"motion": disturbed(started("multiscale", 50))})
    expected = drawn(model, 0.4)
    settings = {"name": "multiscale"}
    found = drawn(load_model(unpack(*pack(model)), settings, (), FACTS, 1.0), 0.4)
    for name, tensor in expected.tensors().items():
        assert (found.tensors()[name] - tensor).abs().max() < 0.05, name


@pytest.mark.parametrize("shape", [(), (5,), (7, 3), (0, 3), (2, 3, 4, 16), (40, 0)])
@pytest.mark.parametrize("kind", ["half", "bytes", "raw"])
def test_values_come_back_to_within_their_bits(kind: str, shape: tuple[int, ...]) -> None:
    values = torch.randn(shape, generator=generator(3)).numpy()
    described = {"x": {"kind": kind, "shape": list(shape), "type": "float32"}}
    data = packing._deflated(packing._ENCODED[kind](values))
    found = unpack({"x": data}, described)["x"].numpy()
    assert found.shape == values.shape and found.dtype == np.float32
    if kind == "raw":
        assert np.array_equal(found, values)
    elif kind == "half":
        assert np.array_equal(found, values.astype(np.float16).astype(np.float32))
    elif values.size:
        columns = values.reshape(-1, shape[-1] if len(shape) > 1 else 1)
        apart = np.abs(found - values).reshape(columns.shape).max(axis=0)
        assert (apart <= 0.5001 * np.ptp(columns, axis=0) / 255 + 1e-6).all()


def test_equal_values_stay_what_they_are() -> None:
    """As the masks of a packed model do, which take next to no bytes."""
    data = packing._deflated(packing._ENCODED["bytes"](np.full(10000, 1.25, np.float32)))
    assert data.nbytes < 60
    described = {"x": {"kind": "bytes", "shape": [10000], "type": "float32"}}
    assert torch.equal(unpack({"x": data}, described)["x"], torch.full((10000,), 1.25))


def test_values_that_are_not_finite_are_not_packed() -> None:
    model = model_of()
    with torch.no_grad():
        model.splats.quats[3, 1] = float("nan")
    with pytest.raises(DataError, match=r"^'splats.quats' holds values that are not finite"):
        pack(model)
    model = model_of()
    with torch.no_grad():
        model.splats.means[3, 1] = 1e6
    with pytest.raises(DataError, match="too large for 16 bits"):
        pack(model)


def damaged(change: dict[str, Any]) -> None:
    packed, described = pack(model_of())
    described["splats.quats"] |= change
    unpack(packed, described)


@pytest.mark.parametrize(
    "change",
    [
        {"shape": [199, 3]},
        {"shape": [10**12, 3]},
        {"shape": [-1, 3]},
        {"shape": None},
        {"kind": "pickle"},
        {"kind": "half"},
    ],
    ids=str,
)
def test_a_description_that_does_not_fit_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises((ValueError, TypeError, LookupError)):
        damaged(change)


def test_damaged_data_is_refused() -> None:
    packed, described = pack(model_of())
    for data in (packed["splats.means"][:-5], torch.zeros(30, dtype=torch.uint8)):
        with pytest.raises(ValueError, match="packed data"):
            unpack(packed | {"splats.means": data}, described)
    high = packing._deflated(bytes([200]) * 180 * 3)
    with pytest.raises(ValueError, match="codes that its codebook has not"):
        unpack(packed | {"splats.quats": high}, described)
    with pytest.raises(KeyError):
        unpack({name: t for name, t in packed.items() if name != "splats.means"}, described)


def test_integers_are_packed_as_they_are() -> None:
    assert packing._kind(Parameter("x", torch.zeros(3, dtype=torch.int32))) == "raw"
    assert packing._kind(Parameter("x", torch.zeros(3))) == "raw"
    assert packing._kind(Parameter("x", torch.zeros(3), rate="network")) == "half"
    assert packing._kind(Parameter("x", torch.zeros(3), True, "network")) == "bytes"
    large = torch.zeros(packing.SMALL + 1)
    assert packing._kind(Parameter("x", large, rate="planes")) == "bytes"
    assert packing._kind(Parameter("splats.means", large, True, "means")) == "half"
