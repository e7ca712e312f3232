"""The model: resize, and that what is saved comes back the same."""

from __future__ import annotations

import pytest
import torch
from motion_checks import FACTS, disturbed, splats_of, started
from torch import Tensor

from gsdmsr_cli import motion as motions
from gsdmsr_cli import plugins
from gsdmsr_cli.errors import DataError
from gsdmsr_cli.model import Model, load_model

COUNT = 9

every_motion = pytest.mark.parametrize("name", plugins.names(motions.__name__))


def model_of(name: str) -> Model:
    return Model(splats_of(COUNT), disturbed(started(name, COUNT)))


def saved(model: Model) -> dict[str, Tensor]:
    """Return copies of the model's tensors, and one of someone else's."""
    tensors = {name: tensor.detach().clone() for name, tensor in model.tensors().items()}
    return {**tensors, "adam.first.splats.means": torch.zeros(COUNT, 3)}


@every_motion
def test_what_is_saved_comes_back_the_same(name: str) -> None:
    model = model_of(name)
    loaded = load_model(saved(model), {"name": name}, FACTS, 1.0)
    assert list(loaded.tensors()) == list(model.tensors())
    for what, tensor in loaded.tensors().items():
        assert torch.equal(tensor, model.tensors()[what]), what
        assert tensor.requires_grad, what
    for time in (0.0, 0.37, 1.0):
        moved, expected = loaded.at(time), model.at(time)
        for what, tensor in moved.tensors().items():
            assert torch.equal(tensor, expected.tensors()[what]), what


@every_motion
def test_a_loaded_model_is_a_copy(name: str) -> None:
    tensors = saved(model_of(name))
    kept = {what: tensor.clone() for what, tensor in tensors.items()}
    loaded = load_model(tensors, {"name": name}, FACTS, 1.0)
    with torch.no_grad():
        for what, tensor in loaded.tensors().items():
            if what.startswith("motion."):
                tensor += 1
    for what, tensor in tensors.items():
        assert torch.equal(tensor, kept[what]), what


def test_a_loaded_model_is_in_the_phase_of_its_progress() -> None:
    model = model_of("multiscale")
    model.motion.advance(0.0)
    early = load_model(saved(model), {"name": "multiscale"}, FACTS, 0.0)
    late = load_model(saved(model), {"name": "multiscale"}, FACTS, 1.0)
    assert torch.equal(early.at(0.5).quats, model.splats.quats)
    assert not torch.equal(late.at(0.5).quats, model.splats.quats)


@every_motion
def test_take_resizes_splats_and_motion_alike(name: str) -> None:
    model = model_of(name)
    rows = torch.tensor([8, 0, 0, 3])
    expected = model.at(0.4).take(rows)
    model.take(rows)
    assert len(model.splats) == 4
    moved = model.at(0.4)
    for what, tensor in moved.tensors().items():
        torch.testing.assert_close(tensor, expected.tensors()[what], atol=1e-6, rtol=1e-6)
    for what, tensor in model.tensors().items():
        assert tensor.is_leaf and tensor.requires_grad and tensor.is_contiguous(), what


def test_a_model_has_its_own_contiguous_leaves() -> None:
    splats = splats_of(COUNT)
    splats = splats.map(lambda t: t.t().contiguous().t() if t.dim() == 2 else t)
    assert not splats.means.is_contiguous()
    model = Model(splats, started("static"))
    for tensor in model.tensors().values():
        assert isinstance(tensor, torch.nn.Parameter) and tensor.is_contiguous()


@pytest.mark.parametrize("name", ["splats.quats", "motion.grid.0.space", "motion.network.2.bias"])
def test_a_missing_tensor_is_told(name: str) -> None:
    tensors = saved(model_of("hexplane"))
    del tensors[name]
    with pytest.raises(DataError, match=name.rpartition(".")[2]) as caught:
        load_model(tensors, {"name": "hexplane"}, FACTS, 1.0)
    assert "\n" not in str(caught.value)


def test_another_shape_is_told_with_both_shapes() -> None:
    tensors = saved(model_of("hexplane"))
    with pytest.raises(DataError, match=r"shape \(3, 2, 64, 64, 16\) for .* \(3, 2, 32, 32, 16\)"):
        load_model(tensors, {"name": "hexplane", "levels": [32, 128]}, FACTS, 1.0)
    tensors["splats.quats"] = torch.zeros(COUNT - 1, 4)
    with pytest.raises(DataError, match="quats has shape"):
        load_model(tensors, {"name": "hexplane"}, FACTS, 1.0)
