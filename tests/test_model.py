"""The model: resize, and that what is saved comes back the same."""

from __future__ import annotations

import pytest
import torch
from motion_checks import FACTS, disturbed, splats_of, started
from torch import Tensor

from gsdmsr_cli import motion as motions
from gsdmsr_cli import plugins
from gsdmsr_cli.errors import DataError
from gsdmsr_cli.model import MOVING, Model, load_model
from gsdmsr_cli.splats import Splats

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


STILL_ROWS = torch.tensor([False, True, True, False, False, True, False, False, True])
ORDER = [0, 3, 4, 6, 7, 1, 2, 5, 8]
"""The rows of those that move, then of those that do not."""


def settled(name: str) -> tuple[Model, Splats]:
    """Return a model of which some splats stand still, and where they all are in the new order."""
    model = model_of(name)
    where = model.at(0.7).map(lambda tensor: tensor.detach().clone())
    order = model.settle(STILL_ROWS, where)
    assert order.tolist() == ORDER and model.moving == 5
    return model, where.take(order)


@every_motion
def test_splats_that_stand_still_stay_and_the_others_move_as_before(name: str) -> None:
    model, where = settled(name)
    before = model_of(name)
    for time in (0.0, 0.37, 1.0):
        moved, unsettled = model.at(time).tensors(), before.at(time).tensors()
        for what, tensor in moved.items():
            assert torch.equal(tensor[5:], where.tensors()[what][5:]), what
            torch.testing.assert_close(
                tensor[:5], unsettled[what][~STILL_ROWS], atol=1e-6, rtol=1e-6
            )


@every_motion
def test_gradients_of_splats_that_stand_still_reach_no_motion(name: str) -> None:
    model, _ = settled(name)
    moved = model.at(0.3)
    parts = [t[5:].square().sum() for t in moved.tensors().values()]
    torch.stack(parts).sum().backward()
    for what, tensor in model.splats.tensors().items():
        assert torch.equal(tensor.grad[5:], 2 * tensor.detach()[5:]), what
    for what, tensor in model.motion.tensors().items():
        assert tensor.grad is None or not tensor.grad.any(), what


@every_motion
def test_what_stands_still_follows_a_resize(name: str) -> None:
    """Rows repeat, are absent and change places, of both kinds."""
    model, _ = settled(name)
    rows = torch.tensor([4, 1, 1, 8, 5, 5])
    expected, names = model.at(0.4).take(rows), model.held_by_motion()
    model.take(rows)
    assert model.moving == 3
    for what, tensor in model.at(0.4).tensors().items():
        torch.testing.assert_close(tensor, expected.tensors()[what], atol=1e-6, rtol=1e-6)
    for what in names:
        assert len(model.tensors()[what]) == 3, what


def test_splats_that_move_come_first() -> None:
    model, _ = settled("static")
    with pytest.raises(ValueError, match="come after"):
        model.take(torch.tensor([0, 5, 1]))
    assert len(model.splats) == COUNT


@every_motion
def test_further_splats_can_be_let_stand_still(name: str) -> None:
    model, first = settled(name)
    later = model.at(0.2).map(lambda tensor: tensor.detach().clone())
    further = torch.tensor([True] + 8 * [False])
    assert model.settle(further, later).tolist() == [1, 2, 3, 4, 0, 5, 6, 7, 8]
    assert model.moving == 4
    assert torch.equal(model.at(0.9).means[4], later.means[0])
    model.settle(torch.arange(COUNT) > 4, later)  # those that stand still already stay there
    assert torch.equal(model.at(0.9).means[5:], first.means[5:])


@every_motion
def test_all_splats_may_stand_still(name: str) -> None:
    model = model_of(name)
    model.settle(torch.ones(COUNT, dtype=torch.bool), model.at(0.5))
    assert torch.equal(model.at(0.1).means, model.at(0.9).means)
    assert model.penalty(0.5, torch.Generator()) is None
    model.take(torch.tensor([3, 3]))
    assert len(model.at(0.1).means) == 2


@every_motion
def test_how_many_move_is_saved(name: str) -> None:
    model, _ = settled(name)
    tensors = {**saved(model), MOVING: torch.tensor(5)}
    loaded = load_model(tensors, {"name": name}, FACTS, 1.0)
    assert loaded.moving == 5
    assert torch.equal(loaded.at(0.6).means, model.at(0.6).means)
    with pytest.raises(DataError, match="10 of 9 splats move"):
        load_model({**tensors, MOVING: torch.tensor(10)}, {"name": name}, FACTS, 1.0)


@every_motion
def test_a_model_takes_the_shapes_of_another(name: str) -> None:
    model, other = settled(name)[0], model_of(name)
    model.take(torch.tensor([1, 0, 3, 5]))
    other.become(4, 3)
    shapes = {what: tensor.shape for what, tensor in model.tensors().items()}
    assert {what: tensor.shape for what, tensor in other.tensors().items()} == shapes
    assert len(other.at(0.5)) == 4


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


@every_motion
@pytest.mark.parametrize("some_still", [False, True])
def test_only_teachers_pass_their_gradients_through_the_motion(name: str, some_still: bool) -> None:
    """The others pass them on to the canonical values alone; the moved values are the same."""
    model = model_of(name)
    if some_still:
        model.settle(torch.arange(COUNT) < 3, model.splats)
    teachers = torch.arange(COUNT) % 2 == 0

    def gradients(teachers: Tensor | None, rows: Tensor) -> dict[str, Tensor]:
        """Of a sum of squares over some of the rows."""
        moved = model.at(0.4, teachers)
        loss = torch.stack([t[rows].square().sum() for t in moved.tensors().values()]).sum()
        given = model.tensors()
        found = torch.autograd.grad(loss, list(given.values()), materialize_grads=True)
        return dict(zip(given, found, strict=True))

    for what, tensor in model.at(0.4, teachers).tensors().items():
        assert torch.equal(tensor, getattr(model.at(0.4), what))
    taught, full = gradients(teachers, teachers), gradients(None, teachers)
    for what, gradient in full.items():
        torch.testing.assert_close(taught[what], gradient, atol=1e-5, rtol=1e-5)
    spared, moved = gradients(teachers, ~teachers), model.at(0.4)
    for what, gradient in spared.items():
        if what.startswith("motion."):
            assert not gradient.any(), what
        else:
            own = 2 * getattr(moved, what.removeprefix("splats.")).detach()
            own[teachers] = 0
            torch.testing.assert_close(gradient, own, atol=1e-5, rtol=1e-5)
