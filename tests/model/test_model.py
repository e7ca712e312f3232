"""The model: resize, and that what is saved comes back the same."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from motion_checks import (
    FACTS,
    disturbed,
    model_of,
    splats_at,
    splats_of,
    stand_still,
    started,
)
from torch import Tensor
from training_checks import per_splat

from gsdmsr_cli.gaussians.splats import NAMES, Splats
from gsdmsr_cli.ground import plugins
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.model import motion as motions
from gsdmsr_cli.model.building import load_model
from gsdmsr_cli.model.model import MOTION, MOVING, STORED, Model
from gsdmsr_cli.training.resizing import Resize, resize_model

COUNT = 9

every_motion = pytest.mark.parametrize("name", plugins.names(motions.__name__))


FRESH = torch.tensor([False, False, True, False])


def moving_model(name: str, /, **options: Any) -> Model:
    return model_of(splats_of(COUNT), disturbed(started(name, COUNT, **options)))


def loaded_from(
    tensors: dict[str, Tensor], name: str, progress: float = 1.0, **options: Any
) -> Model:
    return load_model(tensors, {"name": name, **options}, (), FACTS, progress)


def none_fresh(rows: Tensor) -> Tensor:
    return torch.zeros_like(rows, dtype=torch.bool)


def saved(model: Model) -> dict[str, Tensor]:
    """Return copies of the model's tensors, and one of someone else's."""
    tensors = {name: tensor.detach().clone() for name, tensor in model.tensors().items()}
    return {**tensors, "adam.first.splats.means": torch.zeros(COUNT, 3)}


@every_motion
def test_what_is_saved_comes_back_the_same(name: str) -> None:
    model = moving_model(name)
    loaded = loaded_from(saved(model), name)
    assert list(loaded.tensors()) == list(model.tensors())
    trained = model.trained()
    for what, tensor in loaded.tensors().items():
        assert torch.equal(tensor, model.tensors()[what]), what
        assert tensor.requires_grad == (what in trained), what
    for time in (0.0, 0.37, 1.0):
        moved, expected = splats_at(loaded, time), splats_at(model, time)
        for what, tensor in moved.tensors().items():
            assert torch.equal(tensor, expected.tensors()[what]), what


@every_motion
def test_a_loaded_model_is_a_copy(name: str) -> None:
    tensors = saved(moving_model(name))
    kept = {what: tensor.clone() for what, tensor in tensors.items()}
    loaded = loaded_from(tensors, name)
    with torch.no_grad():
        for what, tensor in loaded.tensors().items():
            if what.startswith("motion."):
                tensor += 1
    for what, tensor in tensors.items():
        assert torch.equal(tensor, kept[what]), what


def test_a_loaded_model_is_in_the_phase_of_its_progress() -> None:
    model = moving_model("multiscale")
    model.advance(0.0)
    early = loaded_from(saved(model), "multiscale", 0.0)
    late = loaded_from(saved(model), "multiscale")
    assert torch.equal(splats_at(early, 0.5).quats, model.splats.quats)
    assert not torch.equal(splats_at(late, 0.5).quats, model.splats.quats)


@every_motion
def test_take_resizes_splats_and_motion_alike(name: str) -> None:
    model = moving_model(name)
    rows = torch.tensor([8, 0, 0, 3])
    expected = splats_at(model, 0.4).take(rows)
    model.take(rows, FRESH)
    assert len(model.splats) == 4
    moved = splats_at(model, 0.4)
    for what, tensor in moved.tensors().items():
        torch.testing.assert_close(tensor, expected.tensors()[what], atol=1e-6, rtol=1e-6)
    trained = model.trained()
    for what, tensor in model.tensors().items():
        assert tensor.is_leaf and tensor.is_contiguous(), what
        assert tensor.requires_grad == (what in trained), what


def held_per_splat(name: str) -> list[str]:
    """Return the names of what a motion holds for each splat that moves."""
    parameters = started(name, COUNT).parameters()
    return [f"{MOTION}.{parameter.name}" for parameter in parameters if parameter.per_splat]


STILL_ROWS = torch.tensor([False, True, True, False, False, True, False, False, True])
ORDER = [0, 3, 4, 6, 7, 1, 2, 5, 8]
"""The rows of those that move, then of those that do not."""


def with_still_splats(name: str) -> tuple[Model, Splats]:
    """Return a model of which some splats stand still, and where they all are in the new order."""
    model = moving_model(name)
    where = splats_at(model, 0.7).map(lambda tensor: tensor.detach().clone())
    assert stand_still(model, STILL_ROWS, where) == ORDER and model.moving == 5
    return model, where.take(torch.tensor(ORDER))


@every_motion
def test_splats_that_stand_still_stay_and_the_others_move_as_before(name: str) -> None:
    model, where = with_still_splats(name)
    before = moving_model(name)
    for time in (0.0, 0.37, 1.0):
        moved, unchanged = splats_at(model, time).tensors(), splats_at(before, time).tensors()
        for what, tensor in moved.items():
            assert torch.equal(tensor[5:], where.tensors()[what][5:]), what
            torch.testing.assert_close(
                tensor[:5], unchanged[what][~STILL_ROWS], atol=1e-6, rtol=1e-6
            )


@every_motion
def test_gradients_of_splats_that_stand_still_reach_no_motion(name: str) -> None:
    model, _ = with_still_splats(name)
    moved = splats_at(model, 0.3)
    parts = [t[5:].square().sum() for t in moved.tensors().values()]
    torch.stack(parts).sum().backward()
    for what, tensor in model.splats.tensors().items():
        assert torch.equal(tensor.grad[5:], 2 * tensor.detach()[5:]), what
    for what, tensor in model.layers[MOTION].tensors().items():
        assert tensor.grad is None or not tensor.grad.any(), what


@every_motion
def test_what_stands_still_follows_a_resize(name: str) -> None:
    """Rows repeat, are absent and change places, of both kinds."""
    model, _ = with_still_splats(name)
    rows = torch.tensor([4, 1, 1, 8, 5, 5])
    expected = splats_at(model, 0.4).take(rows)
    held_by_motion = [what for what in per_splat(model) if what not in STORED]
    model.take(rows, none_fresh(rows))
    assert model.moving == 3
    for what, tensor in splats_at(model, 0.4).tensors().items():
        torch.testing.assert_close(tensor, expected.tensors()[what], atol=1e-6, rtol=1e-6)
    for what in held_by_motion:
        assert len(model.tensors()[what]) == 3, what
    assert held_by_motion == held_per_splat(name)


def test_splats_that_move_come_first() -> None:
    model, _ = with_still_splats("static")
    with pytest.raises(ValueError, match="come after"):
        model.take(torch.tensor([0, 5, 1]), none_fresh(torch.arange(3)))
    assert len(model.splats) == COUNT


@every_motion
def test_further_splats_can_be_let_stand_still(name: str) -> None:
    model, first = with_still_splats(name)
    later = splats_at(model, 0.2).map(lambda tensor: tensor.detach().clone())
    further = torch.tensor([True] + 8 * [False])
    assert stand_still(model, further, later) == [1, 2, 3, 4, 0, 5, 6, 7, 8]
    assert model.moving == 4
    assert torch.equal(splats_at(model, 0.9).means[4], later.means[0])
    stand_still(model, torch.arange(COUNT) > 4, later)  # those that stand still already stay there
    assert torch.equal(splats_at(model, 0.9).means[5:], first.means[5:])


@every_motion
def test_all_splats_may_stand_still(name: str) -> None:
    model = moving_model(name)
    stand_still(model, torch.ones(COUNT, dtype=torch.bool), splats_at(model, 0.5))
    assert torch.equal(splats_at(model, 0.1).means, splats_at(model, 0.9).means)
    assert model.penalty(model.instant(0.5), torch.Generator()) is None
    model.take(torch.tensor([3, 3]), none_fresh(torch.arange(2)))
    assert len(splats_at(model, 0.1).means) == 2


@every_motion
def test_how_many_move_is_saved(name: str) -> None:
    model, _ = with_still_splats(name)
    tensors = {**saved(model), MOVING: torch.tensor(5)}
    loaded = loaded_from(tensors, name)
    assert loaded.moving == 5
    assert torch.equal(splats_at(loaded, 0.6).means, splats_at(model, 0.6).means)
    with pytest.raises(DataError, match="10 of 9 splats move"):
        loaded_from({**tensors, MOVING: torch.tensor(10)}, name)


@every_motion
def test_what_has_stood_still_can_begin_to_move(name: str) -> None:
    """In new rows of the motion, which is nowhere yet; all others stay what they were."""
    model, _ = with_still_splats(name)
    before = splats_at(model, 0.3).map(lambda tensor: tensor.detach().clone())
    rows, fresh = resize_model(model, Resize(torch.arange(COUNT), none_fresh(torch.arange(COUNT)),
                                             moving=torch.arange(COUNT) == 7))  # fmt: skip
    assert rows.tolist() == [0, 1, 2, 3, 4, 7, 5, 6, 8] and model.moving == 6
    assert not fresh.any()
    after = splats_at(model, 0.3)
    old = torch.tensor([0, 1, 2, 3, 4, 6, 7, 8])
    for what, tensor in after.tensors().items():
        expected = before.tensors()[what][rows]
        torch.testing.assert_close(tensor[old], expected[old], atol=1e-6, rtol=1e-6)
        assert tensor.isfinite().all(), what
    held = [model.tensors()[what] for what in held_per_splat(name)]
    assert all(len(tensor) == 6 for tensor in held)
    trained = [tensor for tensor in held if tensor.requires_grad]
    with torch.no_grad():
        for tensor in trained:
            tensor[5] += torch.linspace(0.1, 0.9, tensor[5].numel()).view(tensor[5].shape)
    if trained:
        assert not torch.equal(*(splats_at(model, time).means[5] for time in (0.1, 0.8)))
    stand_still(model, torch.ones(COUNT, dtype=torch.bool), splats_at(model, 0.5))
    everything = torch.ones(COUNT, dtype=torch.bool)
    resize_model(model, Resize(torch.arange(COUNT), ~everything, moving=everything))
    assert model.moving == COUNT and splats_at(model, 0.7).means.isfinite().all()


def test_a_row_that_is_not_there_is_refused() -> None:
    model, _ = with_still_splats("static")
    with pytest.raises(IndexError, match=r"^row 9 of 9 splats$"):
        model.take(torch.tensor([0, 9]), none_fresh(torch.arange(2)))


@every_motion
def test_a_model_takes_the_shapes_of_another(name: str) -> None:
    model, other = with_still_splats(name)[0], moving_model(name)
    model.take(torch.tensor([1, 0, 3, 5]), FRESH)
    other.become(4, 3)
    shapes = {what: tensor.shape for what, tensor in model.tensors().items()}
    assert {what: tensor.shape for what, tensor in other.tensors().items()} == shapes
    assert len(splats_at(other, 0.5)) == 4


def test_a_model_has_its_own_contiguous_leaves() -> None:
    splats = splats_of(COUNT)
    splats = splats.map(lambda t: t.t().contiguous().t() if t.dim() == 2 else t)
    assert not splats.means.is_contiguous()
    model = model_of(splats, started("static"))
    for tensor in model.tensors().values():
        assert isinstance(tensor, torch.nn.Parameter) and tensor.is_contiguous()


@pytest.mark.parametrize("name", ["splats.quats", "motion.grid.0.space", "motion.network.2.bias"])
def test_a_missing_tensor_is_told(name: str) -> None:
    tensors = saved(moving_model("hexplane"))
    del tensors[name]
    with pytest.raises(DataError, match=name.rpartition(".")[2]) as caught:
        loaded_from(tensors, "hexplane")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "tensor", "shape", "found"),
    [
        (
            "hexplane",
            "grid.1.time",
            (3, 2, 8, 32, 16),
            r"a grid of shapes \(3, 2, 128, 128, 16\) in",
        ),
        ("hexplane", "grid.0.space", (3, 2, 64, 32, 16), r"grid .* in time, which do not fit"),
        ("hexplane", "network.1.weight", (64, 48), r"shapes .*\(64, 48\).*, not one from 64 to 10"),
        ("hexplane", "network.2.bias", (9,), "a network of shapes .* to 10"),
        ("multiscale", "coarse_decoder.0.weight", (32, 3), "a network .* from 16 to 3"),
        ("hash_grids", "time.1", (5, 2), r"a table of shape \(5, 2\), not .*, for a hash grid"),
        ("hash_grids", "encoder.0.weight", (32, 64), "a network .* from 48 to 64"),
        ("multiscale", "embeddings", (8, 16), r"\(8, 16\) .* for 'embeddings', not \(9, 16\)"),
        ("multiscale", "embeddings", (9, 32), r"\(9, 32\) .* for 'embeddings', not \(9, 16\)"),
        ("control_points", "log_radii", (1023,), r"\(1024, 3\) control points, 1023 radii"),
        (
            "control_points",
            "control_points",
            (1024, 3, 1),
            "shape .* for 'control_points', not 2 dimensions of torch.float32",
        ),
    ],
)
def test_a_shape_that_does_not_fit_the_others_is_told(
    name: str, tensor: str, shape: tuple[int, ...], found: str
) -> None:
    tensors = saved(moving_model(name))
    tensors[f"motion.{tensor}"] = torch.zeros(shape)
    with pytest.raises(DataError, match=f"the checkpoint holds .*{found}") as caught:
        loaded_from(tensors, name)
    assert "\n" not in str(caught.value)


def test_another_number_of_quaternions_or_kind_of_number_is_told() -> None:
    tensors = saved(moving_model("hexplane"))
    half = {**tensors, "motion.grid.0.time": tensors["motion.grid.0.time"].half()}
    with pytest.raises(DataError, match=r"torch\.float16 for 'grid\.0\.time', not .*float32"):
        loaded_from(half, "hexplane")
    tensors["splats.quats"] = torch.zeros(COUNT - 1, 4)
    with pytest.raises(DataError, match="quats has shape"):
        loaded_from(tensors, "hexplane")


def test_a_grid_of_fewer_levels_is_told() -> None:
    tensors = saved(moving_model("hexplane"))
    with pytest.raises(DataError, match=r"a network of shapes .*, not one from 32 to 10"):
        loaded_from(tensors, "hexplane", levels=[64])


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("hexplane", {"levels": (24, 40)}),
        ("hexplane", {"channels": 16, "time_ratio": 0.7}),
        ("hexplane", {"width": 32, "heads": "shared"}),
        ("multiscale", {"coarse_level": 20, "levels": (12, 24), "width": 48}),
        ("control_points", {"count": 100}),
        ("control_points", {"count": 1500, "levels": (8, 20), "width": 64}),
    ],
)
def test_shapes_come_from_the_file_not_from_the_settings(
    name: str, options: dict[str, Any]
) -> None:
    """As after a motion whose grid or control points have become more in training."""
    model = moving_model(name, **options)
    shapes = {what: tensor.shape for what, tensor in model.tensors().items()}
    begun = {what: t.shape for what, t in moving_model(name).tensors().items()}
    assert shapes != begun and shapes.keys() == begun.keys()
    loaded = loaded_from(saved(model), name)
    assert {what: tensor.shape for what, tensor in loaded.tensors().items()} == shapes
    for time in (0.0, 0.37, 1.0):
        found, expected = splats_at(loaded, time), splats_at(model, time)
        assert not torch.equal(expected.means, model.splats.means)
        for what, tensor in found.tensors().items():
            assert torch.equal(tensor, expected.tensors()[what]), what
    rows = torch.tensor([8, 0, 0, 3])
    loaded.take(rows, FRESH)
    assert torch.equal(splats_at(loaded, 0.37).means, splats_at(model, 0.37).take(rows).means)
    penalty = loaded.penalty(loaded.instant(0.5), torch.Generator())
    assert penalty is not None and penalty.isfinite()


@every_motion
def test_tensors_are_the_same_objects_for_good(name: str) -> None:
    """Whatever a model goes through: who holds one of its tensors always sees what it is now."""
    model = moving_model(name)
    before = model.tensors()
    model.take(torch.tensor([8, 0, 0, 3]), FRESH)
    stand_still(model, ~FRESH, model.splats.detach())
    model.become(7, 5)
    held = held_per_splat(name)
    fewer = {what: t[:5] if what in held else t for what, t in saved(moving_model(name)).items()}
    model.restore(fewer)
    model.to("cpu")
    assert all(tensor is before[what] for what, tensor in model.tensors().items())
    assert all(
        getattr(model.splats, n) is before[what] for n, what in zip(NAMES, STORED, strict=True)
    )


@every_motion
@pytest.mark.parametrize("some_still", [False, True])
def test_only_rows_of_the_mask_pass_their_gradients_through_the_motion(
    name: str, some_still: bool
) -> None:
    """The others pass them on to the canonical values alone; the moved values are the same."""
    model = moving_model(name)
    if some_still:
        stand_still(model, torch.arange(COUNT) < 3, model.splats.detach())
    mask = torch.arange(COUNT) % 2 == 0

    def gradients(mask: Tensor | None, rows: Tensor) -> dict[str, Tensor]:
        """Of a sum of squares over some of the rows."""
        moved = splats_at(model, 0.4, mask)
        loss = torch.stack([t[rows].square().sum() for t in moved.tensors().values()]).sum()
        given = model.trained()
        found = torch.autograd.grad(loss, list(given.values()), materialize_grads=True)
        return dict(zip(given, found, strict=True))

    for what, tensor in splats_at(model, 0.4, mask).tensors().items():
        assert torch.equal(tensor, getattr(splats_at(model, 0.4), what))
    masked, full = gradients(mask, mask), gradients(None, mask)
    for what, gradient in full.items():
        torch.testing.assert_close(masked[what], gradient, atol=1e-5, rtol=1e-5)
    others, moved = gradients(mask, ~mask), splats_at(model, 0.4)
    for what, gradient in others.items():
        if what.startswith("motion."):
            assert not gradient.any(), what
        else:
            own = 2 * getattr(moved, what.removeprefix("splats.")).detach()
            own[mask] = 0
            torch.testing.assert_close(gradient, own, atol=1e-5, rtol=1e-5)
