"""Packed models draw what they did, take few bytes, and are refused where they are damaged."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
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
from gsdmsr_cli.runs import packed_values
from gsdmsr_cli.runs.packing import pack, unpack

COUNT = 200
FILE = Path("packed.safetensors")
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
    loaded = load_model(unpack(*pack(model, 1e-3), FILE), MOTION, LAYERS, FACTS, 1.0)
    assert len(loaded.splats) == COUNT - len(MASKED)
    assert loaded.moving == moving - int((moving > MASKED).sum())
    for time, truth in zip((0.0, 0.7), expected, strict=True):
        found = drawn(loaded, time)
        for name, tensor in truth.tensors().items():
            apart = (found.tensors()[name] - tensor).abs()
            assert apart.max() < 0.02, (name, float(apart.max()))


def test_a_larger_tolerance_leaves_fewer_bytes() -> None:
    """Of the splats, which have at most a fifth then, as of the whole."""
    before = {name: tensor.nbytes for name, tensor in model_of().tensors().items()}
    sizes = []
    for tolerance in (1e-3, 0.08, 0.4):
        packed, described = pack(model_of(), tolerance)
        assert packed.keys() == before.keys() == described["tensors"].keys()
        assert all(tensor.dtype == torch.uint8 for tensor in packed.values())
        sizes.append(sum(tensor.nbytes for tensor in packed.values()))
    assert sizes[0] > 1.1 * sizes[1] and sizes[1] > 1.05 * sizes[2]
    assert sizes[1] < 0.35 * sum(before.values())


@pytest.mark.parametrize("name", ["multiscale", "control_points", "covariance_4d", "polynomial"])
def test_a_model_without_further_layers_is_packed_as_well(name: str) -> None:
    options = {"count": 20} if name == "control_points" else {}
    model = Model(splats_of(50), {"motion": disturbed(started(name, 50, **options))})
    expected = drawn(model, 0.4)
    found = unpack(*pack(model, 1e-3), FILE)
    loaded = drawn(load_model(found, {"name": name, **options}, (), FACTS, 1.0), 0.4)
    for field, tensor in expected.tensors().items():
        assert (loaded.tensors()[field] - tensor).abs().max() < 0.05, field


def test_values_that_are_not_finite_are_not_packed() -> None:
    model = model_of()
    with torch.no_grad():
        model.splats.quats[3, 1] = float("nan")
    with pytest.raises(DataError, match=r"^'splats.quats' holds values that are not finite"):
        pack(model)


def test_what_lies_far_away_takes_no_bits_from_what_is_near() -> None:
    """16 bits between the ends would be too coarse, and halves end before the first."""
    model = model_of()
    with torch.no_grad():
        model.splats.means[3, 1] = 1e6
    before = set(model.splats.means[:, 1].tolist())
    packed, described = pack(model)
    assert described["tensors"]["splats.means"]["kind"] == "raw"
    found = unpack(packed, described, FILE)["splats.means"]
    assert set(found[:, 1].tolist()) < before


def test_another_layout_is_refused_with_a_sentence() -> None:
    packed, described = pack(model_of())
    for found, number in ((described | {"layout": 3}, 3), (described["tensors"], 1)):
        with pytest.raises(DataError) as caught:
            unpack(packed, found, FILE)
        assert str(caught.value) == (
            f"{FILE}: is packed in layout {number}, and this version reads 2; export it again "
            "from the run that it was made of"
        )


def damaged(change: dict[str, Any]) -> None:
    packed, described = pack(model_of())
    described["tensors"]["splats.quats"] |= change
    unpack(packed, described, FILE)


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
            unpack(packed | {"splats.means": data}, described, FILE)
    high, _ = packed_values.encode(np.full((180, 3), 200, np.uint8), packed_values.CODES)
    with pytest.raises(ValueError, match="codes that its codebook has not"):
        unpack(packed | {"splats.quats": high}, described, FILE)
    with pytest.raises(KeyError):
        unpack({name: t for name, t in packed.items() if name != "splats.means"}, described, FILE)
