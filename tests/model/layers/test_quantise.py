"""Rotations and scales are drawn as codes, and learn as if they were drawn exactly."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from kernel_checks import generator
from motion_checks import FACTS, moved_by, splats_of
from seam_checks import assert_trains_the_same_in_all_ways
from torch import Tensor
from training_checks import preset_of

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model.layer import Instant, options_of
from gsdmsr_cli.model.layers import quantise
from gsdmsr_cli.training.trainer import check_plugins

LAYERS = "layers=[{name: quantise, stages: 2, codes: 8, rate: [0.01, 0.01]}]"
EVENTS = "events=[density, opacity_reset, thinning, stillness, {name: codebooks, at: 0.6}]"


def fitted(splats: Splats, **options: object) -> quantise.Quantise:
    """Return a layer whose codebooks stand for the splats, in its last phase."""
    made = quantise.Options(**options)  # type: ignore[arg-type]
    layer = quantise.start(made, FACTS, splats, generator())
    layer.fit(splats, generator())
    layer.advance(1.0)
    return layer


def by_hand(values: Tensor, book: Tensor) -> Tensor:
    """Return sums of codes, each the nearest to what is left, by distances in float64."""
    sums = torch.zeros_like(values).double()
    for stage in book.detach().double():
        rest = values.double() - sums
        sums = sums + stage[(rest[:, None] - stage).square().sum(dim=2).argmin(dim=1)]
    return sums


def test_it_changes_nothing_before_its_codebooks_are_fitted() -> None:
    splats = splats_of(9)
    layer = quantise.start(quantise.Options(), FACTS, splats, generator())
    layer.advance(1.0)
    assert moved_by(layer, splats, 0.3) is splats
    assert layer.penalty(Moment(splats), Instant(0.3), generator()) is None


def test_it_is_known_from_the_tensors_alone_that_codebooks_are_fitted() -> None:
    """As after loading a checkpoint, and in a process that has not fitted them."""
    splats = splats_of(9)
    layer = fitted(splats)
    saved = {name: tensor.detach().clone() for name, tensor in layer.tensors().items()}
    restored, beside = (
        quantise.start(quantise.Options(), FACTS, splats, generator()) for _ in range(2)
    )
    restored.restore(saved, 9)
    with torch.no_grad():
        for name, tensor in beside.tensors().items():
            tensor.copy_(saved[name])
    beside.advance(0.5)
    for other in (restored, beside):
        assert torch.equal(moved_by(other, splats, 0.3).quats, moved_by(layer, splats, 0.3).quats)


def test_rotations_and_scales_are_sums_of_codes_and_all_else_stays() -> None:
    splats = splats_of(300)
    layer = fitted(splats, stages=3, codes=16)
    found = moved_by(layer, splats, 0.3)
    for name, book in layer.books.items():
        expected = by_hand(splats.tensors()[name], book)
        torch.testing.assert_close(found.tensors()[name].double(), expected, rtol=0, atol=1e-5)
    for name in ("means", "logit_opacities", "sh"):
        assert found.tensors()[name] is splats.tensors()[name]


def test_more_stages_and_codes_come_nearer() -> None:
    splats, errors = splats_of(300), []
    for stages, codes in ((1, 8), (2, 8), (4, 32)):
        found = moved_by(fitted(splats, stages=stages, codes=codes), splats, 0.0)
        errors.append(float((found.quats - splats.quats).detach().square().mean()))
    assert errors[0] > 1.5 * errors[1] > 3 * errors[2]


def test_as_many_codes_as_splats_are_nearly_exact() -> None:
    """Four different splats, many times each: k-means finds them."""
    splats = splats_of(4).take(torch.arange(80) % 4)
    found = moved_by(fitted(splats, stages=4, codes=8), splats, 0.0)
    torch.testing.assert_close(found.quats.detach(), splats.quats, rtol=0, atol=1e-4)


def test_stored_values_get_the_gradient_and_the_codebooks_that_of_the_distance() -> None:
    splats = splats_of(40).map(torch.nn.Parameter)
    layer = fitted(splats.detach(), stages=2, codes=4)
    found = moved_by(layer, splats, 0.3)
    for tensor in (found.quats, found.log_scales):
        tensor.sum().backward()
    for name in ("quats", "log_scales"):
        assert torch.equal(splats.tensors()[name].grad, torch.ones_like(splats.tensors()[name]))
    assert all(book.grad is None for book in layer.books.values())
    value = layer.penalty(Moment(splats), Instant(0.3), generator())
    assert value is not None
    value.backward()
    assert all(book.grad is not None and book.grad.any() for book in layer.books.values())
    total = 0.0
    for name, book in layer.books.items():
        values = splats.tensors()[name].detach()
        for stages in (1, 2):
            total += float((values - by_hand(values, book[:stages])).square().sum(1).mean())
    assert float(value.detach()) == pytest.approx(total, rel=1e-4)


def test_it_is_fitted_in_training_which_is_the_same_in_all_ways(
    tiny_scene: Path, tmp_path: Path
) -> None:
    trainer = assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, LAYERS, EVENTS)
    model = trainer.result()
    assert model.tensors()["layers.quantise.fitted"].all()
    layer = model.layers["layers.quantise"]
    splats = moved_by(layer, model.splats, 0.0)
    assert not torch.equal(splats.quats, model.splats.quats)
    assert len(splats.quats.unique(dim=0)) <= 8**2


def test_the_event_needs_the_layer() -> None:
    with pytest.raises(UsageError, match="events names 'codebooks', but layers has no 'qu"):
        check_plugins(preset_of(EVENTS))


@pytest.mark.parametrize(
    ("option", "value", "allowed"),
    [
        ("stages", 0, "1 to 16"),
        ("codes", 257, "2 to 256"),
        ("rate", [0, 1], r"\[start, end\], both above 0"),
    ],
)
def test_bad_options_are_refused(option: str, value: object, allowed: str) -> None:
    with pytest.raises(UsageError, match=f"layers: {option} is .*; allowed: {allowed}$"):
        options_of("gsdmsr_cli.model.layers", {"name": "quantise", option: value})


def test_a_progress_out_of_range_is_refused() -> None:
    with pytest.raises(UsageError, match=r"at is 1.5; allowed: 0 to 1$"):
        check_plugins(preset_of(LAYERS, "events=[density, {name: codebooks, at: 1.5}]"))


def test_a_codebook_of_another_width_is_told() -> None:
    layer = fitted(splats_of(9))
    tensors = {name: t.detach() for name, t in layer.tensors().items()}
    tensors["quats"] = torch.zeros(6, 64, 3)
    with pytest.raises(ValueError, match=r"a codebook of shape \(6, 64, 3\) for 'quats'"):
        layer.restore(tensors, 9)
